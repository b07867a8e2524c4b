"""The search for the cheapest scene that meets targets, on trades that are known in advance."""

import pytest

from pointsplat_ns.compression.budget_search import BUDGETS
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.tradeoff.targets import Targets, TargetSearch
from pointsplat_ns.tradeoff.walk import Plan
from trades import Trade


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


def test_a_limit_of_size_alone_gives_the_best_file_that_fits():
    trade = Trade()
    found = search(trade, Targets(mb=1.0)).run()
    assert 0.99e6 < found.point.bytes <= 1e6
    assert trade.smallest(found.point.against_dense.psnr + 0.01) > 1e6


def test_a_limit_of_time_alone_gives_the_most_that_is_fast_enough():
    found = search(Trade(), Targets(ms=21.0)).run()  # 20,000 Gaussians
    assert 20_000 / BUDGETS.repaired.precision <= found.setting.count <= 20_000
    assert found.setting.repair == "quick"
    assert "the next better" in found.why and "ms a frame where 21 are allowed" in found.why


def test_all_targets_hold_at_once():
    targets = Targets(db=30.0, ms=20.0, mb=3.0)
    point = search(Trade(), targets).run().point
    assert targets.missed(point) == []


def test_a_slower_scene_of_a_smaller_file_does_not_hide_one_that_is_fast_enough():
    """Without SH bands files are smaller, but it takes more Gaussians to reach the quality."""
    trade = Trade(gains={}, cuts={0: 31.0, 1: 32.0, 2: 33.0})
    smallest = search(trade, Targets(db=30.0)).run().point
    assert smallest.sh_degree < 3
    limit = smallest.frame_ms - 1
    fast = search(trade, Targets(db=30.0, ms=limit)).run().point
    assert fast.frame_ms <= limit and fast.bytes > smallest.bytes


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


def test_a_time_that_not_even_a_thousandth_meets_is_an_error():
    with pytest.raises(BudgetError, match=r"no scene meets --target-ms 0.5: \d+ Gaussians still take"):
        search(Trade(), Targets(ms=0.5)).run()


def test_a_file_too_small_for_one_gaussian_is_an_error():
    with pytest.raises(BudgetError, match="too small for one Gaussian"):
        search(Trade(), Targets(mb=1e-6)).run()


def test_a_quality_that_only_the_whole_scene_has_gives_nearly_the_whole_scene():
    trade = Trade(gains={}, at_all=30.0, cuts={0: 1.0, 1: 1.0, 2: 1.0})
    found = search(trade, Targets(db=29.9), ("none",)).run()
    assert found.point.against_dense.psnr >= 29.9
    assert found.setting.count > 0.9 * trade.count


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_smallest_scenes_can_be_searched(count):
    found = search(Trade(count=count, sh_degree=0), Targets(mb=1.0), ("none",)).run()
    assert found.setting.count == count


@pytest.mark.parametrize("targets", [{}, {"db": 0.0}, {"ms": -1.0}, {"mb": float("nan")}, {"db": float("inf")}])
def test_targets_that_mean_nothing_are_refused(targets):
    with pytest.raises(BudgetError, match="--target-"):
        Targets(**targets)
