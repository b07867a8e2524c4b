"""The demo: a result before anything is trained, then the whole method in small."""

import importlib.metadata
import json
import shlex
from pathlib import Path

import pytest

from making import ball, write_run
from pointsplat_ns.cli import demo as module
from pointsplat_ns.cli import main
from pointsplat_ns.io import read_ply, write_ply


@pytest.fixture()
def small_example(tmp_path, monkeypatch):
    """A scene of a few hundred Gaussians in the place of the one that ships."""
    write_ply(ball(400), tmp_path / "example.ply")
    monkeypatch.setattr("pointsplat_ns.api.EXAMPLE", tmp_path / "example.ply")


@pytest.fixture()
def commands(monkeypatch) -> list[str]:
    """Command lines that the demo gave. They run in this process: ten others would import nerfstudio, 20 seconds each.

    That the demo starts processes is seen where one fails. Scenes start from fewer points than it asks for.
    """
    given: list[str] = []

    def run(command: str) -> None:
        given.append(command)
        print(f"\n$ {command}", flush=True)
        program, *rest = words = shlex.split(command.replace("--num-seed-points 20000", "--num-seed-points 500"))
        if program == "pointsplat":
            return main(rest)  # its program ends the process
        [script] = importlib.metadata.entry_points(group="console_scripts", name=program)
        with monkeypatch.context() as patch:
            patch.setattr("sys.argv", words)
            script.load()()

    monkeypatch.setattr("pointsplat_ns.nerfstudio_plugin.running.run", run)
    return given


@pytest.fixture()
def no_training(monkeypatch):
    """The second part of the demo, stopped as soon as it begins."""

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "train_and_judge", stopped)


def test_a_small_scene_and_its_picture_are_there_before_anything_is_trained(
    small_example, commands, no_training, tmp_path, capfd
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


def test_the_demo_runs_end_to_end_and_does_nothing_twice(
    small_example, commands, coarse_rooms, tmp_path, capfd, monkeypatch
):
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
    assert sum(command.startswith("ns-train") for command in commands) == 4 == len(before)
    commands.clear()
    main(["demo", "--output", str(output), *small])
    assert before == {p: p.stat().st_mtime_ns for p in output.rglob("*.ckpt")}
    assert not any(command.startswith("ns-train") for command in commands)


@pytest.fixture()
def earlier(tmp_path) -> tuple[Path, list[Path]]:
    """The folder of a demo that has finished, of 900 and 300 steps, and its checkpoints."""
    scenes, refiner = module.training_folders(tmp_path / "demo")
    return tmp_path / "demo", [*(write_run(scene, 900, 900) for scene in scenes.values()), write_run(refiner, 300, 300)]


@pytest.mark.parametrize("option", ["--scene-steps", "--refiner-steps"])
def test_the_demo_keeps_finished_trainings_of_another_number_of_steps_and_says_what_to_do(
    option, earlier, commands, capfd
):
    output, checkpoints = earlier
    with pytest.raises(SystemExit) as end:
        main(["demo", "--output", str(output), option, "12"])
    said = capfd.readouterr().err
    assert end.value.code == 1 and all(checkpoint.is_file() for checkpoint in checkpoints)
    run, steps = checkpoints[0 if "scene" in option else 3].parents[1], 900 if "scene" in option else 300
    assert said == (
        f"error: {run}: holds a finished training of {steps} steps; expected one of 12 or none; "
        "start over with --force, or name another --output\n"
    )
    assert not commands, "it asks before it makes anything"


def test_with_force_the_demo_starts_over_and_leaves_files_of_others_alone(
    earlier, small_example, commands, no_training
):
    output, checkpoints = earlier
    (output / "notes.txt").write_text("of the user")
    with pytest.raises(SystemExit) as end:
        main(["demo", "--output", str(output), "--scene-steps", "12", "--force"])
    assert end.value.code == 130 and not any(checkpoint.exists() for checkpoint in checkpoints)
    assert (output / "notes.txt").is_file() and (output / "example_compact.ply").is_file()


def test_the_demo_says_which_command_failed(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(module, "compact_example", lambda *_: None)
    output = tmp_path / "demo"
    for seed in range(3):
        Path(output / "rooms" / f"room{seed}").mkdir(parents=True)  # rooms without a photo
    with pytest.raises(SystemExit) as end:
        main(["demo", "--output", str(output)])
    error = capfd.readouterr().err
    assert end.value.code == 1 and "ns-train splatfacto-cpu" in error.splitlines()[-1]
