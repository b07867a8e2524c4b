"""pointsplat tables: what it prints and refuses, and that being killed costs one cell at most."""

import json
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import box_room
from pointsplat_ns.cli import main
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.tables.cells import TABLE_FILES
from pointsplat_ns.tradeoff import machine

FEW = ("--only", "room/dense/*", "room/paper*/*", "--views", "2")


@pytest.fixture(scope="module")
def views() -> ps.Views:
    return sample_views(box_room(0, 400), 3, 48, 36)


@pytest.fixture()
def ply(tmp_path, views, no_lpips, monkeypatch) -> Path:
    """A room of 400 Gaussians, looked at from three views."""
    monkeypatch.setattr(view_source.Sampler, "views", lambda sampler, count, *_, **options: views[:count])
    monkeypatch.setattr(machine, "LOCK", machine.MeasuringLock(str(tmp_path / "lock"), pause=0.0))
    ps.save(box_room(0, 400), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def run(*args) -> None:
    main([str(a) for a in args])


def test_cells_are_printed_as_they_are_measured_and_tables_written(ply, tmp_path, capsys):
    run("tables", ply, "-o", tmp_path / "tables", *FEW)
    said = capsys.readouterr().out
    assert "room/paper-0.7/10%: " in said and "(2 of 8)" in said
    assert "scenes: 8 cells of room" in said
    for name in ("tables.md", "tables.tex", "tables.json", "figure4.png"):
        assert (tmp_path / "tables" / name).stat().st_size > 1000


def test_a_cells_command_measures_it_again(ply, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("tables", "room.ply", "-o", "tables", *FEW)
    cells = json.loads(Path("tables/tables.json").read_text())["cells"]
    [command] = [cell["point"]["command"] for cell in cells if cell["point"]["key"] == "room/paper/30%"]
    assert command == "pointsplat tables room.ply -o tables --only room/paper/30% --views 2"
    capsys.readouterr()
    run(*command.split()[1:])
    assert "room/paper/30%: " in (said := capsys.readouterr().out) and "the same quality as before" in said


def test_damaged_cells_and_unknown_names_are_one_line(ply, tmp_path, capsys):
    journal = tmp_path / "tables" / "room" / TABLE_FILES.cells
    journal.parent.mkdir(parents=True)
    journal.write_text('{"format": "pointsplat-tables-cells", "version": 2, "cells": [{}]}')
    for words, expected in (
        ((), f"error: {journal}: not the cells of a scene's tables (lacks 'of')"),
        (("--force", "--only", "fox/*"), "error: fox/*: no such cell; expected a name such as fox/merge/10%"),
    ):
        with pytest.raises(SystemExit) as ended:
            run("tables", ply, "-o", tmp_path / "tables", *words)
        said = capsys.readouterr().err
        assert ended.value.code == 1 and said.startswith(expected) and said.count("\n") == 1
