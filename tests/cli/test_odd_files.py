"""Pipes, odd files and odd values: no command waits, and each ends with one line."""

import os
import signal
from pathlib import Path

import pytest
from refusing import refusal

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
        ("a.ckpt", ("convert", "a.ckpt", "b.ply"), "a.ckpt: not a regular file"),
        ("sog/meta.json", ("info", "sog/meta.json"), "meta.json: not a regular file"),
        ("run/config.yml", ("export", "run", "-o", "b.ply"), "expected a scene"),
        (
            "a.json",
            ("prune", *ROOM, "--poses", "a.json", "--keep", "auto"),
            "a.json: not a regular file",
        ),
        (
            "model/cameras.bin",
            ("prune", *ROOM, "--poses", "model", "--keep", "auto"),
            "model: no cameras.bin or cameras.txt",
        ),
        (
            "a.safetensors",
            ("compact", *ROOM, "--refiner", "a.safetensors"),
            "a.safetensors: not a regular file",
        ),
        (
            "out/pointsplat-scenes.json",
            ("compact", ".", "-o", "out"),
            "pointsplat-scenes.json: cannot be read (",
        ),
        ("b.ply", ("prune", *ROOM, "-o", "b.ply", "--force"), "b.ply: not a regular file"),
        ("a", ("prune", *ROOM, "-o", "/dev/stdout"), "/dev/stdout: cannot write a nameless file"),
    ],
)
def test_a_pipe_is_refused_in_one_line(pipe, words, said, capsys):
    Path(pipe).parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(pipe)
    assert said in refusal(capsys, Path(), *words)


@pytest.mark.parametrize(
    "words",
    [
        ("info", "loop.ply"),
        ("info", "dangling.ply"),
        ("info", "/dev/zero"),
        ("info", "folder.ply"),
        ("info", "many.ply"),
        ("info", "long.ply"),
        ("info", "run"),
        ("compact", "sparse.splat"),
        ("prune", "room.ply", "--keep", "1e309"),
        ("prune", "room.ply", "--poses", "deep.json", "--by", "pup"),
        ("prune", *ROOM, "-o", "room.ply/out.ply"),
        ("prune", *ROOM, "-o", "x" * 300 + ".ply"),
        ("prune", *ROOM, "-o", "/proc/out.ply"),
        ("convert", "room.ply", "\udcff\n.obj"),
        ("render", "room.ply", "--width", "0"),
        ("render", "room.ply", "--fps", "nan"),
        ("lod", "room.ply", "-o", "room.ply"),
        ("clean", "room.ply", "--strength", "inf"),
        ("export", ".", "-o", "a.ply"),
    ],
)
def test_odd_files_and_values_are_one_line(words, capsys):
    ply = Path("room.ply").read_bytes()
    Path("many.ply").write_bytes(ply.replace(b"vertex 40", b"vertex 999999999999999"))
    Path("long.ply").write_bytes(
        ply.replace(b"element", b"comment " + b"x" * (1 << 21) + b"\nelement", 1)
    )
    Path("deep.json").write_text("[" * 100_000)
    Path("folder.ply").mkdir()
    Path("run").mkdir()
    Path("run/config.yml").write_text("!!python/object/apply:os.system ['touch ran']")
    Path("loop.ply").symlink_to("loop.ply")
    Path("dangling.ply").symlink_to("nowhere.ply")
    with Path("sparse.splat").open("wb") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(SystemExit) as end:
        main([*words])
    error = capsys.readouterr().err
    assert end.value.code == 1 and not Path("ran").exists(), error
    assert [line.startswith("error: ") for line in error.splitlines()].count(
        True
    ) == 1 and "Traceback" not in error
