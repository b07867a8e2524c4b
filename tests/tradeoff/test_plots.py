"""Plots: the front is what no other point beats, and every kind of point can be drawn."""

import math
from dataclasses import replace

import pytest
from matplotlib.image import imread

from pointsplat_ns.tradeoff.outputs import SWEEP_FILES, plot
from pointsplat_ns.tradeoff.points import Tradeoff
from pointsplat_ns.tradeoff.settings import DENSE, REPAIRS, Setting
from trades import point


def sweep(photos: float | None, repairs=REPAIRS) -> Tradeoff:
    points = [point(Setting(100_000, 3, by=DENSE), math.inf, 100.0, photos)]
    for number, repair in enumerate(repairs):
        lower = None if photos is None else photos - 1 - number
        points.append(point(Setting(10_000 - 100 * number, 3 - number % 2, repair), 30.0 - number, 10 + number, lower))
    return Tradeoff("room", "a machine", "given views", 64, 48, tuple(points), recommended=points[-1].key)


@pytest.mark.parametrize("against", SWEEP_FILES.plots)
@pytest.mark.parametrize("photos, wide", [(28.0, True), (None, False)])
def test_there_is_a_panel_for_renders_and_one_for_photos_where_there_are_any(against, photos, wide, tmp_path):
    plot(sweep(photos), against, tmp_path / "plot.png")
    height, width = imread(tmp_path / "plot.png").shape[:2]
    assert (width > 2 * height) == wide


def test_what_is_recommended_shows(tmp_path):
    shown = sweep(None, ("none",))
    plot(shown, "frame_ms", tmp_path / "with.png")
    plot(replace(shown, recommended="dense"), "frame_ms", tmp_path / "without.png")
    assert (imread(tmp_path / "with.png") != imread(tmp_path / "without.png")).any()


def test_a_sweep_that_has_only_begun_can_be_drawn(tmp_path):
    plot(sweep(28.0, ()), "bytes", tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000
