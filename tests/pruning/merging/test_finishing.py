"""The choice of two numbers by renders."""

from __future__ import annotations

import math

import pytest

from making import ball
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.windows import WindowRenders
from pointsplat_ns.pruning.merging.finishing import Finish, best_finish, top_of_parabola


@pytest.mark.parametrize(
    ("at", "values", "margin", "want"),
    [
        pytest.param((-1.0, 0.0, 2.0), [-((x - 0.7) ** 2) for x in (-1, 0, 2)], 0.0, 0.7, id="a top inside"),
        pytest.param((0.0, 1.0, 2.0), [-((x - 9.0) ** 2) for x in range(3)], 0.5, 2.5, id="a top above"),
        pytest.param((0.0, 1.0, 2.0), [-((x + 9.0) ** 2) for x in range(3)], 0.5, -0.5, id="a top below"),
        pytest.param((0.0, 1.0, 2.0), [1.0, 1.0, 1.0], 0.5, 0.0, id="level"),
        pytest.param((0.0, 1.0, 2.0), [3.0, 1.0, 2.0], 0.5, 0.0, id="a valley, the left side higher"),
        pytest.param((0.0, 1.0, 2.0), [1.0, 0.0, 2.0], 0.5, 2.0, id="a valley, the right side higher"),
        pytest.param((0.0, 1.0, 2.0), [0.0, 0.0, 2.0], 0.5, 2.0, id="level, then rising"),
        # A flower scene gained 1.3 dB at each step, more at each, and stopped 0.8 dB short of what it could have.
        pytest.param((0.0, 1.0, 2.0), [0.0, 1.0, 2.0], 0.5, 2.5, id="rising evenly"),
        pytest.param((0.0, 1.0, 2.0), [0.0, 1.0, 3.0], 0.5, 2.5, id="rising ever faster"),
        pytest.param((0.0, 1.0, 2.0), [3.0, 1.0, 0.0], 0.5, -0.5, id="falling ever slower"),
        pytest.param((0.0, 1.0, 2.0), [2.0, 1.0, 0.0], 0.5, -0.5, id="falling evenly"),
    ],
)
def test_the_top_of_a_parabola_within_margins_or_else_the_best_trial(at, values, margin, want):
    assert top_of_parabola(at, values, margin) == pytest.approx(want)


def test_not_a_number_is_never_chosen():
    assert math.isfinite(top_of_parabola((0.0, 1.0, 2.0), [math.nan, 1.0, 2.0], 0.5))


def faded(dense: Gaussians, opacity: float, size: float):
    """A function from a finish to the scene as if one step too faint and too small."""

    def make(finish: Finish) -> Gaussians:
        return dense.replace(
            opacities=dense.opacities + 20 * (finish.depth_exponent - opacity),
            scales=dense.scales + finish.size_change - size,
        )

    return make


@pytest.mark.parametrize(("opacity", "size"), [(0.1, -0.04), (0.25, 0.03), (0.0, 0.0)])
def test_the_numbers_that_undo_a_known_change_are_found(opacity, size):
    dense = ball(500)
    reference, make = WindowRenders(dense, sample_views(dense, 3, width=96, height=72)), faded(dense, opacity, size)
    found = best_finish(lambda finish: reference.psnr(make(finish)))
    assert found.psnr >= found.psnr_before
    assert reference.psnr(make(found)) == pytest.approx(found.psnr)
    assert found.size_change == pytest.approx(size, abs=0.03) or found.psnr > found.psnr_before + 3


@pytest.mark.parametrize(("top", "exponents"), [(0.2, {0.2}), (-0.1, {-0.1, 0.0}), (0.4, {0.4, 0.3})])
def test_sizes_are_tried_at_the_top_and_outside_of_the_trials_at_the_nearest_trial_as_well(top, exponents):
    tried = []

    def psnr_of(finish: Finish) -> float:
        tried.append(finish)
        return 30 - (finish.depth_exponent - top) ** 2 - finish.size_change**2

    found = best_finish(psnr_of)
    assert {round(finish.depth_exponent, 9) for finish in tried if finish.size_change} == exponents
    assert (found.depth_exponent, found.size_change) == pytest.approx((top, 0.0)) and found.psnr == pytest.approx(30)
    assert len(tried) == len(set(tried)), "rendered twice"


def test_the_note_is_one_line():
    assert Finish(0.2, math.log(0.95), 31.0, 30.0).note == (
        "merged: optical depth x members^0.20, sizes x 0.950, chosen by renders: 30.00 -> 31.00 dB"
    )
    assert Finish().note.endswith("by default")
