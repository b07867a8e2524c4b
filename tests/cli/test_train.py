"""Commands that train, make levels and tables."""

import json
import re
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball, box_room
from pointsplat_ns.cli import main
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.nerfstudio_plugin.captures import dataparser_for
from pointsplat_ns.tables.cells import TABLE_FILES
from pointsplat_ns.tradeoff import machine


@pytest.mark.parametrize(
    ("files", "name"),
    [
        (["transforms.json"], "NerfstudioDataParserConfig"),
        (["traj.txt", "results/frame000000.png"], "ReplicaDataParserConfig"),
        (["dslr/nerfstudio/transforms.json", "transforms.json"], "SeededScanNetppDataParserConfig"),
        (["colmap/sparse/0/cameras.bin", "colmap/cameras.bin"], "ColmapDataParserConfig"),
        (["sparse/cameras.bin"], "ColmapDataParserConfig"),
        (["sparse/0/cameras.txt"], "ColmapDataParserConfig"),
    ],
)
def test_a_capture_is_read_by_the_dataparser_of_its_files(files, name, tmp_path):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    found = dataparser_for(tmp_path)
    assert type(found).__name__ == name
    if name == "ColmapDataParserConfig":
        assert found.colmap_path == Path(files[0]).parent


def test_a_run_of_exactly_as_many_gaussians_is_trained(wall_scene, tmp_path, capsys):
    main(["train", str(wall_scene), "--keep", "0.2k", "--steps", "30", "-o", str(tmp_path)])
    said = capsys.readouterr().out.splitlines()[-1]
    run, _, rest = said.partition(": ")
    assert rest == "a run of 200 Gaussians" and Path(run).parent == tmp_path / wall_scene.name / "splatfacto-cpu"
    assert len(ps.load(run)) == 200


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["no_such"], "no_such: no such folder; expected a capture"),
        (["."], r"\.: no capture that is known; expected transforms.json, a COLMAP model"),
        ([".", "--keep", "0"], "--keep 0: expected a number of Gaussians, at least 1"),
        ([".", "--steps", "0"], "0 steps at a scale of 1; expected at least 1"),
        ([".", "--scale", "1.5"], "7000 steps at a scale of 1.5; expected .* up to 1"),
    ],
)
def test_what_cannot_be_trained_is_said_in_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["train", *words])
    assert end.value.code == 1
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert re.search(message, said)
    assert not list(tmp_path.iterdir())


@pytest.fixture()
def ply(tmp_path) -> Path:
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def run(*args) -> None:
    main([str(a) for a in args])


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((), {}),
        (("--levels", "10%", "0.5", "20", "--sh", "0"), {"levels": [0.5, "10%", 20], "sh": "0"}),
        (("--levels", "0.01MB"), {"levels": ["0.01MB"]}),
    ],
)
def test_pointsplat_lod_writes_what_lod_gives_bit_for_bit(arguments, options, ply, tmp_path):
    run("lod", ply, *arguments, "-o", tmp_path / "by_command")
    ps.lod(ply, **options).save(tmp_path / "by_api")
    assert contents(tmp_path / "by_command") == contents(tmp_path / "by_api")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--levels", "50%", "200"), "levels 50% and 200 both mean 200 of 400 Gaussians"),
        (("--levels", "auto:35"), "level auto:35: expected a ratio"),
        (("--levels", "401"), "level 401: keep is 401 Gaussians"),
        (("-o", "levels.ply"), "levels.ply: levels are several files; expected the name of a folder"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line_and_writes_nothing(arguments, message, ply, tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        run("lod", ply, *arguments)
    said = capsys.readouterr()
    assert caught.value.code == 1 and said.out == ""
    [line] = said.err.splitlines()
    assert line.startswith("error: ") and message in line
    assert [path.name for path in tmp_path.iterdir()] == ["room.ply"]


FEW = ("--only", "room/dense/*", "room/paper*/*", "--views", "2")


@pytest.fixture(scope="module")
def views() -> ps.Views:
    return sample_views(box_room(0, 400), 3, 48, 36)


@pytest.fixture()
def ply_path(tmp_path, views, no_lpips, monkeypatch) -> Path:
    """A room of 400 Gaussians, looked at from three views."""
    monkeypatch.setattr(view_source.Sampler, "views", lambda sampler, count, *_, **options: views[:count])
    monkeypatch.setattr(machine, "LOCK", machine.MeasuringLock(str(tmp_path / "lock"), pause=0.0))
    ps.save(box_room(0, 400), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def test_a_cells_command_measures_it_again(ply_path, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("tables", "room.ply", "-o", "tables", *FEW)
    cells = json.loads(Path("tables/tables.json").read_text())["cells"]
    [command] = [cell["point"]["command"] for cell in cells if cell["point"]["key"] == "room/paper/30%"]
    assert command == "pointsplat tables room.ply -o tables --only room/paper/30% --views 2"
    capsys.readouterr()
    run(*command.split()[1:])
    assert "room/paper/30%: " in (said := capsys.readouterr().out) and "the same quality as before" in said


def test_damaged_cells_and_unknown_names_are_one_line(ply_path, tmp_path, capsys):
    journal = tmp_path / "tables" / "room" / TABLE_FILES.cells
    journal.parent.mkdir(parents=True)
    journal.write_text('{"format": "pointsplat-tables-cells", "version": 2, "cells": [{}]}')
    for words, expected in (
        ((), f"error: {journal}: not the cells of a scene's tables (lacks 'of')"),
        (("--force", "--only", "fox/*"), "error: fox/*: no such cell; expected a name such as fox/merge/10%"),
    ):
        with pytest.raises(SystemExit) as ended:
            run("tables", ply_path, "-o", tmp_path / "tables", *words)
        said = capsys.readouterr().err
        assert ended.value.code == 1 and said.startswith(expected) and said.count("\n") == 1
