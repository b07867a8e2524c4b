"""The walk over settings, and targets."""

import itertools

import pytest

from pointsplat_ns.compression.budget_search import BUDGETS
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.tradeoff.front import loss_of, psnr_within
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Setting
from pointsplat_ns.tradeoff.targets import Targets, TargetSearch
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


def search(trade: Trade, targets: Targets, repairs=("none", "quick")) -> TargetSearch:
    return TargetSearch(
        targets, Plan(trade.count, trade.sh_degree, repairs=repairs), trade.measure, trade.cut, "3 views"
    )


@pytest.mark.parametrize("db", [20.0, 27.0, 30.5, 36.0, 41.0])
@pytest.mark.parametrize("gain", [3.0, 0.0])
def test_the_smallest_file_of_a_quality_is_found_in_few_tries(db, gain):
    trade = Trade(gains={"quick": gain})
    found = search(trade, Targets(db=db)).run()
    tries = len(trade.asked)
    assert found.point.against_dense.psnr >= db
    assert trade.smallest(db) <= found.point.bytes <= BUDGETS.repaired.precision * trade.smallest(db)
    assert tries <= 20


def test_it_decides_count_degree_and_repair_from_the_scene():
    views_matter = Trade(gains={"quick": 2.0}, cuts={0: 15.0, 1: 16.0, 2: 17.0})
    assert search(views_matter, Targets(db=30.0)).run().setting.sh_degree == 3
    plain = Trade(gains={"quick": -1.0}, cuts={0: 60.0, 1: 61.0, 2: 62.0})
    chosen = search(plain, Targets(db=30.0)).run().setting
    assert (chosen.sh_degree, chosen.repair) == (0, "none")


def test_what_the_next_cheaper_would_have_missed_is_said():
    found = search(Trade(), Targets(db=30.0)).run()
    assert "dB against the dense scene's renders in 3 views, " in found.why
    assert "dB where 30 are wanted" in found.why and "the next cheaper" in found.why


def test_all_targets_hold_at_once():
    targets = Targets(db=30.0, ms=20.0, mb=3.0)
    point = search(Trade(), targets).run().point
    assert targets.missed(point) == []


@pytest.mark.parametrize(
    "targets, said",
    [(Targets(db=40.0, mb=0.5), "over --target-mb 0.5"), (Targets(db=40.0, ms=3.0), "over --target-ms 3")],
)
def test_targets_that_exclude_one_another_name_the_obstacle_and_the_best_reachable(targets, said):
    trade = Trade()
    with pytest.raises(BudgetError, match="no scene meets all targets: what reaches 40 dB") as refused:
        search(trade, targets).run()
    assert said in str(refused.value)
    best = search(Trade(), Targets(ms=targets.ms, mb=targets.mb)).run().point
    assert f"the best within the limits has {best.against_dense.psnr:.2f} dB" in str(refused.value)


@pytest.mark.parametrize("targets", [{}, {"db": 0.0}, {"ms": -1.0}, {"mb": float("nan")}, {"db": float("inf")}])
def test_targets_that_mean_nothing_are_refused(targets):
    with pytest.raises(BudgetError, match="--target-"):
        Targets(**targets)
