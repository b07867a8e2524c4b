"""``python -m lab.tables``: its output, the commands that measure cells again, and errors in one line."""

import json
import shlex
import sys
from pathlib import Path

import pytest

from lab.common.printing import start
from lab.tables.__main__ import main
from lab.tables.cells import TABLE_FILES

FEW = ("--only", "room/dense/*", "room/paper*/*", "--views", "2")


@pytest.fixture()
def run(monkeypatch):
    """A function that runs the program with words of a command line."""

    def run(*words: object) -> None:
        monkeypatch.setattr(sys, "argv", ["tables", *map(str, words)])
        start(main)

    return run


def test_a_cells_command_measures_it_again(run, room, tmp_path, capsys, caplog, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("room.ply", "-o", "tables", *FEW)
    assert "tables: tables.md, tables.tex, tables.json and figure4.png" in capsys.readouterr().out
    cells = json.loads(Path("tables/tables.json").read_text())["cells"]
    [command] = [cell["point"]["command"] for cell in cells if cell["point"]["key"] == "room/paper/30%"]
    assert command == "python -m lab.tables room.ply -o tables --only room/paper/30% --views 2"
    caplog.clear()
    run(*shlex.split(command)[3:])
    assert "room/paper/30%: " in caplog.text and "the same quality as before" in caplog.text


def test_damaged_cells_and_unknown_names_are_one_line(run, room, tmp_path):
    journal = tmp_path / "tables" / "room" / TABLE_FILES.cells
    journal.parent.mkdir(parents=True)
    journal.write_text('{"format": "pointsplat-tables-cells", "version": 2, "cells": [{}]}')
    for words, expected in (
        ((), f"error: {journal}: not the cells of a scene's tables (lacks 'of')"),
        (("--force", "--only", "fox/*"), "error: fox/*: no such cell; expected a name such as fox/merge/10%"),
    ):
        with pytest.raises(SystemExit) as ended:
            run(room, "-o", tmp_path / "tables", *words)
        assert str(ended.value).startswith(expected) and "\n" not in str(ended.value)
