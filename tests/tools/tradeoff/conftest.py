"""A small room that is measured within seconds."""

from collections.abc import Callable
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import box_room
from pointsplat_ns.pipeline import repair_budget, view_provider
from pointsplat_ns.scene.views import Views
from pointsplat_ns.tools.tradeoff.points import Tradeoff
from pointsplat_ns.view_sampling.sampler import sample_views
from quick import quick_settings


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """A closed box of 400 Gaussians, as a file."""
    path = tmp_path_factory.mktemp("room") / "room.ply"
    ps.save(box_room(0, 400), path)
    return path


@pytest.fixture(scope="session")
def room_views(room) -> Views:
    """Three small views of it."""
    with quick_settings():
        return sample_views(ps.load(room), 3, 48, 36)


@pytest.fixture()
def measured(room, room_views, tmp_path, monkeypatch) -> Callable[..., Tradeoff]:
    """A function that measures the room in these views, by default merged to a tenth, to the folder
    ``out``. Repairs take two steps."""
    monkeypatch.setitem(repair_budget.STEPS, "quick", 2)
    monkeypatch.setattr(
        view_provider.Sampler, "views", lambda sampler, count, *_, **options: room_views[:count]
    )

    def measure(**options) -> Tradeoff:
        usual = {"keep": ["10%"], "repairs": ["none"]}
        return ps.measure_tradeoff(room, tmp_path / "out", **{**usual, **options})

    return measure
