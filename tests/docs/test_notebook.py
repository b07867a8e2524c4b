"""The notebooks run from top to bottom and show what they promise."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

DOCS = Path(__file__).parents[2] / "docs"

SUPPORT = Path(__file__).parents[1] / "support"

SMALLER = f"""
import sys

sys.path.insert(0, {str(SUPPORT)!r})
import pointsplat_ns as ps
from pointsplat_ns import api
from pointsplat_ns.pipeline import repair_budget

from quick import quick_settings

settings = quick_settings()
settings.__enter__()
ps.save(ps.example_room()[::30], "room.ply")
api.EXAMPLE = "room.ply"
repair_budget.STEPS["quick"] = 2
"""
"""Run before all cells: the scene that ships cut to a thirtieth, a repair of two steps, few and
small views."""


@pytest.fixture()
def run_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], list[Any]]:
    """A function from a notebook's name to the outputs of all its cells, in order. It runs in a
    folder of its own, on one thread; 300 seconds are for a machine that is busy."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))

    def outputs(name: str) -> list[Any]:
        notebook = nbformat.read(DOCS / name, as_version=4)
        notebook.cells.insert(0, nbformat.v4.new_code_cell(SMALLER))
        resources = {"metadata": {"path": str(tmp_path)}}
        NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
        return [
            output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
        ]

    return outputs


def pictures_in(outputs: list[Any]) -> int:
    """Number of pictures."""
    return sum("image/png" in output.get("data", {}) for output in outputs)


def printed(outputs: list[Any]) -> str:
    """All that cells printed."""
    return "".join(output.text for output in outputs if output.output_type == "stream")


def test_quick_start_shows_three_pictures_and_says_what_compacting_brought(run_notebook):
    outputs = run_notebook("quickstart.ipynb")
    assert pictures_in(outputs) == 3
    assert "dB PSNR against the dense scene" in printed(outputs)


def test_a_step_of_adam_by_hand_lowers_the_loss_and_a_picture_shows_it(run_notebook):
    outputs = run_notebook("pointsplat_by_hand.ipynb")
    assert pictures_in(outputs) == 1
    before, after = re.search(r"loss ([\d.]+) -> ([\d.]+)", printed(outputs)).groups()
    assert 0 < float(after) < float(before)
