"""Outputs: refused, replaced, interrupted."""

import os
from pathlib import Path

import pytest
from refusing import refusal

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import main
from pointsplat_ns.pipeline import repair

pytestmark = pytest.mark.usefixtures("quick")

FAILING = (
    "prune damaged.ply -o OUT.ply",
    "compact damaged.ply -o OUT.spz",
    "compact damaged.ply -o small.ply --html OUT.html",
    "convert damaged.ply OUT.sog",
    "info damaged.ply --views OUT.png",
    "render damaged.ply -o OUT.mp4",
    "lod damaged.ply -o OUT",
    "tradeoff damaged.ply -o OUT",
    "render damaged.ply -o OUT",
)
"""Commands that fail at their work, because the scene is damaged, unless they find before that they
cannot write."""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("damaged.ply").write_text("ply")
    return tmp_path


@pytest.mark.parametrize("words", FAILING)
def test_a_place_that_takes_no_files_is_named_before_the_scene_is_read(words, here, capsys):
    words = words.replace("OUT", "damaged.ply/OUT")
    output = next(word for word in words.split() if "OUT" in word)
    assert refusal(capsys, here, *words.split()).startswith(f"error: {output}: cannot be written (")


WRITES = {
    "room_pruned.ply": ("prune", "room.ply", "--keep", "50%", "--by", "opacity"),
    "small.sog": ("compact", "room.ply", "--keep", "50%", "--effort", "instant", "-o", "small.sog"),
    "first.png": ("render", "room.ply", "-o", "first.png", "--width", "16", "--height", "12"),
}
"""Commands by a file that they write."""


@pytest.mark.parametrize("name", WRITES)
def test_an_interrupted_write_leaves_nothing_new_and_what_was_there_stays(
    name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    ps.save(ball(40, opacity=1.0, bright=1.0), "room.ply")
    Path(name).write_text("from before")
    replace = os.replace

    def interrupted(part, target):
        if Path(target).name == name:
            assert Path(part).stat().st_size > 0, "nothing was written yet"
            raise KeyboardInterrupt
        replace(part, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(SystemExit) as end:
        main([*WRITES[name], "--force"])
    assert end.value.code == 130 and capsys.readouterr().err.endswith("interrupted\n")
    assert Path(name).read_text() == "from before"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("options", [(), ("--json",)], ids=["text", "json"])
def test_a_repair_that_is_interrupted_is_written_and_the_status_says_so(
    options, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    ps.save(ball(150, log_size=-1.0, opacity=1.0, bright=1.0), "room.ply")
    steps = repair.optimised

    def interrupted(*arguments):
        yield next(steps(*arguments))
        raise KeyboardInterrupt

    monkeypatch.setattr(repair, "optimised", interrupted)
    with pytest.raises(SystemExit) as end:
        main(
            ["compact", "room.ply", "--keep", "50%", "--by", "opacity", "--seconds", "60", *options]
        )
    out, err = capsys.readouterr()
    assert end.value.code == 130 and err.endswith("interrupted\n")
    assert "room_compact.ply" in out and len(ps.load("room_compact.ply")) == 75
