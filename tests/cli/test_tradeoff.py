"""pointsplat tradeoff: that it does what measure_tradeoff does, and what it prints and refuses."""

import inspect
import json
import re
import shlex
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import box_room, same_bits
from pointsplat_ns.cli import main
from pointsplat_ns.cli.tradeoff import tradeoff
from pointsplat_ns.compression import repair
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.tradeoff import judging, machine, outputs

FEW = ("--views", "2", "--repairs", "none")


@pytest.fixture(scope="module")
def views():
    return sample_views(box_room(0, 400), 3, 48, 36)


@pytest.fixture()
def ply(tmp_path, views, plain_page, no_lpips, monkeypatch) -> Path:
    """A room of 400 Gaussians, looked at from three views; repairs take two steps, plots are none, and
    times are as counts are."""
    monkeypatch.setattr(view_source.Sampler, "views", lambda sampler, count, *_, **options: views[:count])
    monkeypatch.setattr(outputs, "plot", lambda sweep, against, path: path.write_text(against))
    monkeypatch.setattr(judging, "_timed", lambda scene, view: 1e-5 * len(scene))
    monkeypatch.setattr(machine, "LOCK", machine.MeasuringLock(str(tmp_path / "lock"), pause=0.0))
    monkeypatch.setitem(repair.STEPS, "quick", 2)
    ps.save(box_room(0, 400), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def run(*args) -> None:
    main([str(a) for a in args])


def refusal(capsys, *args) -> str:
    with pytest.raises(SystemExit) as ended:
        run("tradeoff", *args)
    assert ended.value.code == 1
    return capsys.readouterr().err


def test_a_sweep_is_written_beside_the_scene_and_printed(ply, capsys):
    run("tradeoff", ply, "--points", "3", *FEW)
    folder = ply.with_name("room_tradeoff")
    content = json.loads((folder / "tradeoff.json").read_text("utf-8"))
    said = capsys.readouterr().out
    assert f"room: 3 points, 48 x 36 pixels, {content['views_origin']}" in said and content["machine"] in said
    for point in content["points"]:
        rows = {re.split(r" \*? *│", line.strip(" │"))[0].strip(): line for line in said.splitlines()}
        row = rows[point["label"]]
        assert f"{point['gaussians']:,}" in row and f"{point['speed']['median']:.1f} (" in row
    assert content["why"] in said and str(folder / "tradeoff.html") in said


@pytest.mark.parametrize("within, next_best", [("30", False), ("1e-9", True)])  # anything will do, or nothing
def test_the_recommended_point_or_the_next_best_is_printed_with_a_command(ply, capsys, monkeypatch, within, next_best):
    run("tradeoff", ply, "--points", "3", "--within", within, *FEW)
    [command] = [line[2:] for line in capsys.readouterr().out.splitlines() if line.startswith("$ ")]
    monkeypatch.chdir(ply.parent)
    program, *words = shlex.split(command)
    run(*words)
    content = json.loads((ply.parent / "room_tradeoff" / "tradeoff.json").read_text())
    key = content["recommended"]
    if next_best:
        assert key == "dense"
        key = max(content["points"][1:], key=lambda point: point["against_dense"]["psnr"])["key"]
    assert program == "pointsplat" and f"room_{key}.ply" in words
    assert len(ps.load(f"room_{key}.ply")) < 400


@pytest.mark.parametrize("error", [KeyboardInterrupt, ps.SceneError])
def test_a_sweep_that_ends_before_its_first_point_leaves_nothing_of_its_own(error, ply, tmp_path, monkeypatch):
    def failing(*_):
        assert list((folder / "pictures").glob("*dense.png")), "nothing was written yet"
        raise error("now")

    monkeypatch.setattr(judging, "_timed", failing)
    for folder in (tmp_path / "new", tmp_path / "old"):
        (tmp_path / "old" / "pictures").mkdir(parents=True, exist_ok=True)
        (tmp_path / "old" / "pictures" / "mine.png").touch()
        with pytest.raises(error):
            ps.measure_tradeoff(ply, folder, points=2, views=2, repairs=("none",))
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "old").rglob("*")] == ["pictures", "mine.png"]


def test_a_target_is_met_by_the_scene_that_is_written(ply, tmp_path, capsys):
    run("tradeoff", ply, "-o", tmp_path / "found", "--target-mb", "0.01", *FEW)
    said = capsys.readouterr().out
    [written] = (tmp_path / "found").glob("*.ply")
    assert written.stat().st_size <= 10_000 and f"written to {written}" in said
    [command] = [line[2:] for line in said.splitlines() if line.startswith("$ ")]
    _, *words = shlex.split(command)
    run(*words[:-1], tmp_path / "again.ply")
    assert same_bits(ps.load(tmp_path / "again.ply"), ps.load(written))


def test_a_quality_is_reached_and_what_is_cheaper_is_said(ply, tmp_path, capsys):
    run("tradeoff", ply, "-o", tmp_path / "found", "--target-db", "25", *FEW)
    said = " ".join(capsys.readouterr().out.split())
    content = json.loads((tmp_path / "found" / "tradeoff.json").read_text())
    [found] = [point for point in content["points"] if point["key"] == content["recommended"]]
    assert found["against_dense"]["psnr"] >= 25
    assert "scenes tried; the next cheaper," in said and "dB where 25 are wanted" in said


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("--target-db", "0"), "--target-db is 0; expected a positive number"),
        (("--points", "1"), "1 points; expected at least 2"),
        (("--by", "magic"), "no method is called 'magic'"),
        (("--within", "-1"), "a loss of -1 dB"),
    ],
)
def test_numbers_that_mean_nothing_are_refused_before_the_scene_is_read(tmp_path, capsys, arguments, said):
    assert said in refusal(capsys, tmp_path / "gone.ply", *arguments)


def test_the_command_line_has_the_options_and_defaults_of_the_function():
    function, command = inspect.signature(ps.measure_tradeoff).parameters, inspect.signature(tradeoff).parameters
    assert set(function) - {"folder", "progress"} == set(command) - {"output", "threads", "json_output"}
    assert all(function[name].default == command[name].default for name in set(function) & set(command))
