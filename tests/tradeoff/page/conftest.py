"""A trade that was measured once for all tests of its page."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import pointsplat_ns as ps
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.tradeoff.page import flight_beside, keep_scene, write_sweep_page
from pointsplat_ns.tradeoff.points import Tradeoff
from sweeps import measured_room, room_views

FLOWN = "0.1_coverage"
"""Key of the one point whose scene is kept to fly through. No point is recommended."""


def frame() -> FlightFrame:
    """The frame of flights through the room."""
    return FlightFrame.of(ps.example_room(), room_views())


@pytest.fixture(scope="session")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tradeoff, Path]:
    """A trade with photos, and its folder; shared by all tests, so do not write there. Its times are made up."""
    folder = tmp_path_factory.mktemp("sweep")
    room = ps.example_room()
    measured = measured_room(folder, room)
    keep_scene(frame(), room[::10], measured.point(FLOWN), folder)
    # The one that opacity chose is slower and worse than the larger one.
    times = [95.0 if p.by == "opacity" else 100 * p.share for p in measured.points]
    timed = [
        replace(p, frame_ms=ms, frame_ms_low=0.9 * ms, frame_ms_high=1.2 * ms)
        for p, ms in zip(measured.points, times, strict=True)
    ]
    return replace(measured, points=tuple(timed)), folder


@pytest.fixture(scope="session")
def make_page(sweep, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A function that writes the page of the trade, with parts of it replaced."""

    def make(**replaced) -> Path:
        measured, folder = sweep
        measured, output = replace(measured, **replaced), tmp_path_factory.mktemp("page") / "trade.html"
        return write_sweep_page(measured, folder, output, flight_beside(frame(), folder, "dense", measured.recommended))

    return make
