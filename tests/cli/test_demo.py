"""The demo: a result before anything is trained, then the whole method in small."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from making import ball
from pointsplat_ns.cli import demo as module
from pointsplat_ns.cli import main
from pointsplat_ns.io import read_ply, write_ply


@pytest.fixture()
def small_example(tmp_path, monkeypatch):
    """A scene of a few hundred Gaussians in the place of the one that ships."""
    write_ply(ball(400), tmp_path / "example.ply")
    monkeypatch.setattr("pointsplat_ns.api.EXAMPLE", tmp_path / "example.ply")


@pytest.fixture()
def no_training(monkeypatch):
    """The second part of the demo, stopped as soon as it begins."""

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "train_and_judge", stopped)


def test_a_small_scene_and_its_picture_are_there_before_anything_is_trained(
    small_example, no_training, tmp_path, capfd
):
    output = tmp_path / "a demo"
    output.mkdir()
    (output / "example_compact.ply").write_text("of a demo before")
    with pytest.raises(SystemExit) as end:
        main(["demo", "--output", str(output), "--keep", "0.25"])
    assert end.value.code == 130
    assert len(read_ply(output / "example_compact.ply")) == 100
    assert (output / "example.png").stat().st_size > 10_000
    said = capfd.readouterr().out
    command = f"$ pointsplat compact '{output / 'example.ply'}' --keep 0.25"
    order = [command, "example.png: the scene before and after", "open it in any 3DGS viewer", "made in "]
    order += ["usable result", "about 15 minutes", "stopped at any time with Ctrl-C", "started again"]
    places = [said.find(text) for text in order]
    assert -1 not in places and places == sorted(places), list(zip(order, places, strict=True))


def test_the_demo_runs_end_to_end_and_does_nothing_twice(small_example, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("POINTSPLAT_LPIPS_WEIGHTS", str(tmp_path))  # no weights there, and no download
    output = tmp_path / "demo"
    small = "--scene-steps 12 --refiner-steps 3 --frames 11 --width 64 --height 48 --keep 0.5".split()
    main(["demo", "--output", str(output), *small])
    shown = capfd.readouterr().out
    assert "room2   │ never │ dense" in shown and "refined" in shown
    assert (output / "before_after.png").stat().st_size > 10_000
    results = json.loads((output / "evaluation.json").read_text())["results"]
    assert results["scenes"]["room2"]["seen_in_training"] is False
    assert results["scenes"]["room0"]["seen_in_training"] is True
    kept = results["scenes"]["room2"]["refined"]["gaussians"]
    assert len(read_ply(output / "room2_refined.ply")) == kept
    assert abs(kept - results["scenes"]["room2"]["dense"]["gaussians"] / 2) <= 1
    before = {p: p.stat().st_mtime_ns for p in output.rglob("*.ckpt")}
    main(["demo", "--output", str(output), *small])
    assert before == {p: p.stat().st_mtime_ns for p in output.rglob("*.ckpt")}
    assert "ns-train" not in capfd.readouterr().out


def test_the_demo_says_which_command_failed(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(module, "compact_example", lambda *_: None)
    output = tmp_path / "demo"
    for seed in range(3):
        Path(output / "rooms" / f"room{seed}").mkdir(parents=True)  # rooms without a photo
    with pytest.raises(SystemExit) as end:
        main(["demo", "--output", str(output)])
    error = capfd.readouterr().err
    assert end.value.code == 1 and "ns-train splatfacto-cpu" in error.splitlines()[-1]
