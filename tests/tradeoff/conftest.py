"""A small room that sweeps measure within seconds."""

from collections.abc import Callable
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import box_room
from pointsplat_ns.compression import repair
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.tradeoff.making import Subject
from pointsplat_ns.tradeoff.table import Sweep
from pointsplat_ns.views import Views


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """A closed box of 400 Gaussians, as a file."""
    path = tmp_path_factory.mktemp("room") / "room.ply"
    ps.save(box_room(0, 400), path)
    return path


@pytest.fixture(scope="session")
def room_views(room) -> Views:
    """Three small views of it."""
    return sample_views(ps.load(room), 3, 48, 36)


@pytest.fixture()
def new_sweep(room, room_views, plain_page, no_lpips, monkeypatch) -> Callable[..., Sweep]:
    """A function (folder, options) that begins a sweep of the room, whose repairs take two steps."""
    monkeypatch.setitem(repair.STEPS, "quick", 2)

    def begin(folder: Path, held_out=None, sha256="sum", **options) -> Sweep:
        dense = ps.load(room)
        subject = Subject(dense, room, "room", lambda: ViewSource(dense, given=room_views), held_out)
        return Sweep(subject, sha256, folder, **{"progress": lambda what, share: None, **options})

    return begin
