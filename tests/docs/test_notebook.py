"""The notebook runs from top to bottom and shows what it promises."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.xdist_group("notebook")  # one process runs it for all tests of this file

NOTEBOOK = Path(__file__).parents[2] / "docs" / "quickstart.ipynb"

SMALLER = """
import pointsplat_ns as ps
from pointsplat_ns import api
from pointsplat_ns.compression import repair

ps.save(ps.prune(ps.example_room(), 3000, by="coverage"), "room.ply")
api.EXAMPLE, repair.STEPS["quick"] = "room.ply", 2
"""
"""Run before all cells: the scene that ships cut to a tenth, and a repair of two steps."""

CELL_TIMEOUT = 300
"""Seconds, for a machine that is busy with other things; an idle core runs all cells in less."""


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> nbformat.NotebookNode:
    """The notebook with what its cells put out, run in a folder of its own on one thread."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(SMALLER))
    folder = tmp_path_factory.mktemp("notebook")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.setenv("MPLCONFIGDIR", str(folder))
        client = NotebookClient(
            notebook, timeout=CELL_TIMEOUT, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
        )
        client.execute()
    return notebook


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def test_notebook_shows_three_pictures(executed):
    assert sum("image/png" in output.get("data", {}) for output in outputs(executed)) == 3


def test_notebook_says_what_compacting_brought(executed):
    said = "".join(output.text for output in outputs(executed) if output.output_type == "stream")
    assert "dB PSNR against the dense scene" in said
