"""Pipes in place of files, which have no end: no command waits for one, wherever it is named or found."""

import os
import signal
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import main

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")

SECONDS = 300
"""Longest time of a command here; what waits for a pipe takes for ever."""

ROOM = ("room.ply", "--by", "opacity")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """A folder with a scene, in which a command that hangs is ended."""

    def hangs(number, frame):
        pytest.fail(f"still running after {SECONDS} s")

    monkeypatch.chdir(tmp_path)
    ps.save(ball(40, opacity=1.0, bright=1.0), "room.ply")
    before = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize(
    "pipe, words, said",
    [
        ("a.ply", ("info", "a.ply"), "a.ply: not a regular file"),
        ("a", ("info", "a"), "a: not a regular file"),
        ("a.ckpt", ("convert", "a.ckpt", "b.ply"), "a.ckpt: not a regular file"),
        ("sog/meta.json", ("info", "sog/meta.json"), "meta.json: not a regular file"),
        ("run/config.yml", ("export", "run", "-o", "b.ply"), "expected a scene"),
        ("a.json", ("prune", *ROOM, "--poses", "a.json", "--keep", "auto"), "a.json: not a regular file"),
        ("model/cameras.bin", ("prune", *ROOM, "--poses", "model", "--keep", "auto"), "model: a folder without"),
        ("a.json", ("render", "room.ply", "--path", "a.json"), "a.json: not a regular file"),
        ("a.safetensors", ("compact", *ROOM, "--refiner", "a.safetensors"), "a.safetensors: not a regular file"),
        ("a.ckpt", ("compact", *ROOM, "--refiner", "a.ckpt"), "a.ckpt: not a regular file"),
        ("out/pointsplat-scenes.json", ("compact", ".", "-o", "out"), "pointsplat-scenes.json: cannot be read ("),
        ("out/tradeoff.json", ("tradeoff", "room.ply", "-o", "out"), "tradeoff.json: not the points of a sweep"),
        ("b.ply", ("prune", *ROOM, "-o", "b.ply", "--force"), "b.ply: not a regular file"),
        ("a", ("prune", *ROOM, "-o", "/dev/stdout"), "/dev/stdout: cannot write a nameless file"),
    ],
)  # fmt: skip
def test_a_pipe_is_refused_in_one_line(pipe, words, said, capsys):
    Path(pipe).parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(pipe)
    with pytest.raises(SystemExit) as end:
        main([*words])
    error = capsys.readouterr().err
    assert end.value.code == 1 and error.count("\n") == 1 and said in error
