"""A page of two scenes, and a merging without end, for all tests of this folder."""

import threading
from pathlib import Path

import pytest

import pointsplat_ns as ps
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.tools.pages import slider_scenes as kept
from room_views import room_views


@pytest.fixture(scope="session")
def rooms() -> list[Gaussians]:
    """The example room with a twentieth of its Gaussians, and with a hundredth."""
    return [ps.example_room()[::20], ps.example_room()[::100]]


@pytest.fixture(scope="session")
def written(rooms, tmp_path_factory) -> Path:
    """The page; shared by all tests, so do not write to it."""
    return ps.write_page(
        rooms,
        tmp_path_factory.mktemp("page") / "room.html",
        ["dense", "compact"],
        views=room_views(),
    )


@pytest.fixture()
def endless(monkeypatch) -> tuple[threading.Event, threading.Event]:
    """Merging does not end until it is stopped: events of its begin and its end."""
    begun = threading.Event()
    ended = threading.Event()

    def merged(merger, count, progress):
        begun.set()
        try:
            while True:
                progress(0.5)
        finally:
            ended.set()

    monkeypatch.setattr(kept.Merger, "merged", merged)
    return begun, ended
