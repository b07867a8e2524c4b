"""The choice of two numbers by small renders."""

from __future__ import annotations

import math

import pytest
import torch

from making import ball
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.pruning.finishing import Finish, Reference, top_of_parabola


def test_the_top_of_a_parabola():
    at = (-1.0, 0.0, 2.0)
    assert top_of_parabola(at, [-((x - 0.7) ** 2) for x in at], beyond=0.0) == pytest.approx(0.7)


def test_a_top_outside_is_moved_to_the_border():
    at = (0.0, 1.0, 2.0)
    assert top_of_parabola(at, [-((x - 9.0) ** 2) for x in at], beyond=0.5) == 2.5
    assert top_of_parabola(at, [-((x + 9.0) ** 2) for x in at], beyond=0.5) == -0.5


@pytest.mark.parametrize(
    ("values", "want"), [([1.0, 1.0, 1.0], 0.0), ([3.0, 1.0, 2.0], 0.0), ([1.0, 0.0, 2.0], 2.0), ([0.0, 0.0, 2.0], 2.0)]
)
def test_without_a_top_it_is_the_best_that_was_tried(values, want):
    assert top_of_parabola((0.0, 1.0, 2.0), values, beyond=0.5) == want


@pytest.mark.parametrize("values", [[0.0, 1.0, 2.0], [0.0, 1.0, 3.0]])
def test_where_values_rise_ever_faster_it_goes_on_to_the_border(values):
    """A flower scene gained 1.3 dB at each step, more at each, and stopped 0.8 dB short of what it could have."""
    assert top_of_parabola((0.0, 1.0, 2.0), values, beyond=0.5) == 2.5
    assert top_of_parabola((0.0, 1.0, 2.0), values[::-1], beyond=0.5) == -0.5


def test_not_a_number_is_never_chosen():
    assert math.isfinite(top_of_parabola((0.0, 1.0, 2.0), [math.nan, 1.0, 2.0], beyond=0.5))


def faded(dense: Gaussians, opacity: float, size: float):
    """A function from a finish to the scene as if one step too faint and too small."""

    def make(finish: Finish) -> Gaussians:
        return dense.replace(
            opacities=dense.opacities + 20 * (finish.deepening - opacity), scales=dense.scales + finish.spread - size
        )

    return make


@pytest.mark.parametrize(("opacity", "size"), [(0.1, -0.04), (0.25, 0.03), (0.0, 0.0)])
def test_the_numbers_that_undo_a_known_change_are_found(opacity, size):
    dense = ball(500)
    reference = Reference(dense, sample_views(dense, 3, width=96, height=72))
    found = reference.best(faded(dense, opacity, size))
    assert found.psnr >= found.before
    assert reference.psnr(faded(dense, opacity, size)(found)) == pytest.approx(found.psnr)
    assert found.spread == pytest.approx(size, abs=0.03) or found.psnr > found.before + 3


class Told(Reference):
    """Knows how good each finish is."""

    def __init__(self, top: float):
        self.top = top

    def psnr(self, scene: Finish) -> float:
        return 30 - (scene.deepening - self.top) ** 2 - scene.spread**2


@pytest.mark.parametrize(("top", "gone_on_with"), [(0.2, {0.2}), (-0.1, {-0.1, 0.0}), (0.4, {0.4, 0.3})])
def test_spreads_are_tried_at_the_top_and_where_it_is_a_guess_at_the_nearest_tried_as_well(top, gone_on_with):
    tried = []
    found = Told(top).best(lambda finish: tried.append(finish) or finish)
    with_spread = {round(finish.deepening, 9) for finish in tried if finish.spread}
    assert with_spread == gone_on_with
    assert (found.deepening, found.spread) == pytest.approx((top, 0.0)) and found.psnr == pytest.approx(30)
    assert len(tried) == len(set(tried)), "rendered twice"


def test_what_was_chosen_is_said_in_one_line():
    assert Finish(0.2, math.log(0.95), 31.0, 30.0).note == (
        "merged: optical depth x members^0.20, sizes x 0.950, chosen by renders: 30.00 -> 31.00 dB"
    )
    assert Finish().note.endswith("by default")


def test_equal_pictures_have_a_finite_psnr():
    dense = ball(100)
    assert Reference(dense, sample_views(dense, 1, width=32, height=24)).psnr(dense) == 100.0
    assert torch.isfinite(dense.means).all()
