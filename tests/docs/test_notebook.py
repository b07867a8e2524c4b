"""The notebook runs from top to bottom and shows what it promises."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "docs" / "quickstart.ipynb"

SMALLER = """
import pointsplat_ns as ps
from pointsplat_ns import api
from pointsplat_ns.pipeline import repair_budget
from pointsplat_ns.pipeline import view_provider

ps.save(ps.example_room()[::30], "room.ply")
api.EXAMPLE = "room.ply"
repair_budget.STEPS["quick"] = 2
view_provider.RESOLUTION = (64, 48)
"""
"""Run before all cells: the scene that ships cut to a thirtieth, a repair of two steps,
small views."""


def test_notebook_shows_three_pictures_and_says_what_compacting_brought(tmp_path, monkeypatch):
    """In a folder of its own, on one thread; 300 seconds are for a machine that is busy."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(SMALLER))
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [
        output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    ]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    said = "".join(output.text for output in outputs if output.output_type == "stream")
    assert "dB PSNR against the dense scene" in said
