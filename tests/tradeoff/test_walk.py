"""The walk: what it tries, what it leaves, where it ends, on trades that are known in advance."""

import itertools
import math
from dataclasses import replace

import pytest

from pointsplat_ns.tradeoff.front import loss_of, psnr_within
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Setting
from pointsplat_ns.tradeoff.walk import WALK, Enough, Plan, measure_walk
from trades import Trade


def walked(trade: Trade, plan: Plan | None = None, most: int = 100, known: int = 0) -> dict[Setting, Point]:
    """Everything that a walk measures, in order; the first ``known`` points of it are there from the beginning."""
    plan = plan or Plan(trade.count, trade.sh_degree)
    measured = dict(itertools.islice(walked(trade, plan, most).items(), known)) if known else {}

    def measure(setting: Setting) -> Point:
        if setting not in measured:
            if len(measured) == most:
                raise Enough
            measured[setting] = trade.measure(setting)
        return measured[setting]

    measure_walk(plan, measure, trade.dense, trade.cut)
    return measured


def test_the_first_scene_is_merged_to_a_tenth_and_repairs_are_tried_there():
    assert list(walked(Trade(), most=2)) == [Setting(10_000, 3), Setting(10_000, 3, "quick")]


@pytest.mark.parametrize("gain, used", [(2.0, True), (0.01, False), (-1.0, False)])
def test_a_repair_is_used_from_there_on_only_if_it_pays(gain, used):
    later = [*walked(Trade(gains={"quick": gain}))][2:]
    assert later and {setting.repair for setting in later} == {"quick" if used else "none"}


@pytest.mark.parametrize(
    "cuts, tried",
    [
        ({0: 20.0, 1: 32.0, 2: 40.0}, {3, 1}),  # merged to a tenth: 31.7 dB
        ({0: 10.0, 1: 15.0, 2: 20.0}, {3}),
        ({0: 31.0, 1: 31.1, 2: 31.2}, {3}),
    ],
)
def test_a_lower_sh_degree_is_tried_only_where_its_lack_costs_no_more_than_merging_did(cuts, tried):
    assert {setting.sh_degree for setting in walked(Trade(gains={}, cuts=cuts))} == tried


def test_a_degree_that_is_worse_than_fewer_gaussians_of_the_same_size_is_left_after_one_try():
    trade = Trade(gains={}, slope=0.5, at_all=30.0, cuts={0: 28.4, 1: 28.4, 2: 28.4})  # merging costs next to nothing
    assert [setting.count for setting in walked(trade) if setting.sh_degree == 0] == [10_000]


def test_a_scene_without_sh_bands_has_one_way():
    assert {s.sh_degree for s in walked(Trade(sh_degree=0), Plan(100_000, 0))} == {0}


def test_it_ends_where_the_front_is_flat():
    flat = Trade(slope=0.01, at_all=60.0, gains={}, cuts={0: 1.0, 1: 1.0, 2: 1.0})
    assert len(walked(flat)) == 4  # a tenth, the repair there, and the two other budgets


def test_when_it_ends_no_gap_is_both_steep_and_wide():
    trade = Trade(gains={}, cuts={0: 1.0, 1: 1.0, 2: 1.0})
    measured = walked(trade)
    losses = {s.count: loss_of(p, trade.dense) for s, p in measured.items() if s.repair == "none"}
    losses[trade.count] = 0.0
    for fewer, more in itertools.pairwise(sorted(losses)):
        assert losses[fewer] - losses[more] < WALK.flat or more < WALK.close * fewer
    assert min(losses) == 3_000, "nothing below what was asked for"


@pytest.mark.parametrize("within, most, factor", [(0.5, 11, 1.25), (2.0, 11, 1.25), (0.1, 100, WALK.close)])
def test_what_will_be_recommended_is_looked_for_first(within, most, factor):
    """With 12 points, the smallest scene within the loss is known to a quarter of its count."""
    trade = Trade(sh_degree=0, gains={})
    plan = Plan(trade.count, 0, repairs=("none",), within=within)
    fit = [s.count for s, p in walked(trade, plan, most).items() if loss_of(p, trade.dense) <= within]
    truly = next(n for n in range(1, trade.count) if trade.psnr(Setting(n, 0)) >= psnr_within(within))
    assert truly <= min(fit) <= factor * truly


@pytest.mark.parametrize("known", [1, 3, 6, 10])
def test_an_interrupted_walk_goes_on_as_it_would_have(known):
    whole, resumed = walked(Trade(), most=14), walked(Trade(), most=14, known=known)
    assert list(whole) == list(resumed)


def test_photos_go_before_renders():
    """Against photos nothing is lost above three tenths, so no budget above it is looked at."""
    trade = Trade(gains={}, cuts={0: 1.0, 1: 1.0, 2: 1.0})
    dense = replace(trade.dense, against_photos=replace(trade.dense.against_dense, psnr=30.0))
    measured: dict[Setting, Point] = {}

    def measure(setting: Setting) -> Point:
        kept = min(0.0, 5 * math.log2(setting.count / 30_000))
        made = trade.measure(setting)
        measured[setting] = replace(made, against_photos=replace(made.against_dense, psnr=30.0 + kept))
        return measured[setting]

    measure_walk(Plan(trade.count, 3, repairs=("none",)), measure, dense, trade.cut)
    assert max(setting.count for setting in measured) == 30_000
    assert len(measured) > 6
