"""The choice of a size change by renders."""

import math

import pytest

from making import ball
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.sizes import RendersOfSizes, sides_of
from pointsplat_ns.pruning.merging.finishing import Finish, best_finish, top_of_parabola
from pointsplat_ns.pruning.merging.settings import MERGING


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


@pytest.mark.parametrize("change", [-0.08, -0.04, 0.03, 0.0])
def test_the_size_change_that_undoes_a_known_one_is_found(change):
    dense = ball(500)
    reference = RendersOfSizes(dense, sample_views(dense, 3, width=96, height=72), sides_of(96, 72))

    def psnr_of(trial: float) -> float:
        return reference.psnr(dense.replace(scales=dense.scales + trial - change))

    found = best_finish(psnr_of)
    assert found.psnr_before == psnr_of(0.0) <= found.psnr == psnr_of(found.size_change)
    assert found.size_change == pytest.approx(change, abs=0.03)


def test_the_top_of_the_trials_is_tried_too():
    tried = []

    def psnr_of(change: float) -> float:
        tried.append(change)
        return 30 - (change + 0.06) ** 2

    found = best_finish(psnr_of)
    assert found.size_change == pytest.approx(-0.06) and found.psnr == pytest.approx(30)
    assert tried == [*MERGING.size_changes, pytest.approx(-0.06)]


def test_the_note_is_one_line():
    note = Finish(math.log(0.95), 31.0, 30.0).note
    assert note == "sizes of merged Gaussians x 0.950, chosen by renders: 30.00 -> 31.00 dB"
    assert Finish().note.endswith("by default")
