"""A small room whose tables are measured within seconds."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from lab.tables import layout
from lab.tables.cells import Tables
from lab.tables.measure import measure_tables
from making import box_room
from pointsplat_ns.pipeline import repair_budget, view_provider
from pointsplat_ns.refinement import Refiner, refiner_preset
from pointsplat_ns.refinement.weights import save_refiner
from quick import quick_settings


@pytest.fixture(scope="session")
def weights(tmp_path_factory) -> Callable[..., Path]:
    """A function that writes a refiner that makes everything more opaque, and gives its path."""
    folder = tmp_path_factory.mktemp("weights")

    def write(name: str, metadata: dict, **changes) -> Path:
        torch.manual_seed(7)
        network = Refiner(refiner_preset("tiny", **changes))
        with torch.no_grad():
            [*network.heads.mlps["opacities"].modules()][-1].bias.fill_(0.5)
        path = folder / f"{name}.safetensors"
        save_refiner(network, path, {"scenes": "elsewhere", **metadata})
        return path

    return write


@pytest.fixture(scope="session")
def views_of_room() -> ps.Views:
    with quick_settings():
        return ps.sample_views(box_room(0, 400), 3, 48, 36)


@pytest.fixture()
def room(tmp_path, views_of_room, no_lpips, monkeypatch) -> Path:
    """A closed box of 400 Gaussians as a file, looked at from three views; repairs take two steps,
    figures are none."""
    monkeypatch.setattr(
        view_provider.Sampler, "views", lambda sampler, count, *_, **options: views_of_room[:count]
    )
    monkeypatch.setattr(
        layout, "plot_figure", lambda cells, groups, path: path.write_text("a figure")
    )
    monkeypatch.setitem(repair_budget.STEPS, "quick", 2)
    ps.save(box_room(0, 400), tmp_path / "room.ply")
    return tmp_path / "room.ply"


@pytest.fixture()
def measured(room, tmp_path) -> Callable[..., Tables]:
    """A function that measures the room's tables in a folder, at 30 %, with two steps of
    fine-tuning."""

    def measure(*scenes: Path, folder: Path = tmp_path / "tables", **options):
        usual = {"keeps": (0.3,), "views": 2, "fine_tune": 2, "splat_transform": "/no/such/program"}
        return measure_tables(scenes or (room,), folder, **{**usual, **options})

    return measure
