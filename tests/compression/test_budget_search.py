"""Budgets found by rendering."""

import math

import pytest

from pointsplat_ns.compression.budget_search import BUDGETS, needed_sh_degree, smallest_within
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.pruning import METHODS, cut_sh, score_of, select


@pytest.mark.parametrize("wanted", [22.0, 30.0])
def test_the_scene_found_is_good_enough_and_a_little_smaller_one_is_not(hollow_ball, ball_views, wanted):
    scores = score_of(hollow_ball, METHODS["coverage"])
    calls, shares = [], []

    def make(count):
        calls.append(count)
        return hollow_ball[select(scores, count)]

    found = smallest_within(hollow_ball, make, ball_views, wanted, shares.append)
    reference = DenseReference(hollow_ball, ball_views)
    assert found.psnr == reference.psnr(found.scene)[0] >= wanted and found.worst <= found.psnr + 1e-9
    count = len(found.scene)
    below = [k for k in calls if k < count]
    assert found.psnr <= wanted + BUDGETS.psnr.tolerance or count <= max(
        max(below) * BUDGETS.psnr.precision, max(below) + 1
    )
    assert all(found.tried[k] < wanted for k in below)
    assert len(calls) == len(set(calls)) <= 8 and all(0 <= share <= 1 for share in shares)


def test_a_psnr_that_any_scene_reaches_keeps_one_gaussian(hollow_ball, ball_views):
    assert len(smallest_within(hollow_ball, lambda k: hollow_ball[:k], ball_views, 0.1).scene) == 1


def test_a_psnr_that_only_the_whole_scene_reaches_keeps_it(ball_views, make_hollow_ball):
    whole = make_hollow_ball(40)
    found = smallest_within(whole, lambda k: whole[:k], ball_views, 300.0)
    errors = {k: psnr for k, psnr in found.tried.items() if k < len(found.scene)}
    assert math.isinf(found.psnr) and all(psnr < 300 for psnr in errors.values())


def test_a_psnr_out_of_reach_is_said(hollow_ball, ball_views):
    with pytest.raises(BudgetError, match="all 1500 Gaussians reach .* dB, not 60 dB"):
        smallest_within(hollow_ball, lambda k: cut_sh(hollow_ball, 0)[:k], ball_views, 60.0)
    for wanted in (0.0, -3.0, math.nan, math.inf):
        with pytest.raises(BudgetError, match="expected a positive number"):
            smallest_within(hollow_ball, lambda k: hollow_ball[:k], ball_views, wanted)
    with pytest.raises(BudgetError, match="no view"):
        smallest_within(hollow_ball, lambda k: hollow_ball[:k], ball_views[:0], 30.0)


def test_the_sh_degree_found_is_the_lowest_that_is_good_enough(hollow_ball, ball_views):
    reference = DenseReference(hollow_ball, ball_views)
    reached = [reference.psnr(cut_sh(hollow_ball, degree))[0] for degree in range(3)]
    assert reached[0] < reached[1] < reached[2] == math.inf
    for degree in (0, 1):
        assert needed_sh_degree(hollow_ball, ball_views, reached[degree] - 0.01) == (
            degree,
            pytest.approx(reached[degree]),
        )
    assert needed_sh_degree(hollow_ball, ball_views, reached[1] + 0.01) == (2, math.inf)
