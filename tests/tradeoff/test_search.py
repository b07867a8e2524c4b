"""The search for targets, on trades that are known in advance."""

import pytest

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.tradeoff.points import Setting
from pointsplat_ns.tradeoff.search import PRECISION, Targets, TargetSearch
from trades import Trade


def search(trade: Trade, targets: Targets) -> TargetSearch:
    whole = Setting(trade.count, trade.sh_degree)
    return TargetSearch(targets, whole, ("none", "quick"), trade.measure, trade.cut, "3 views")


@pytest.mark.parametrize("db", [20.0, 27.0, 30.5, 36.0, 41.0])
@pytest.mark.parametrize("gain", [3.0, 0.0])
def test_the_smallest_file_of_a_quality_is_found_in_few_tries(db, gain):
    trade = Trade(gains={"quick": gain})
    found = search(trade, Targets(db=db)).run()
    tries = len(trade.asked)
    assert found.point.against_dense.psnr >= db
    assert trade.smallest(db) <= found.point.bytes <= PRECISION * trade.smallest(db)
    assert tries <= 20


def test_it_decides_count_degree_and_repair_from_the_scene():
    views_matter = Trade(gains={"quick": 2.0}, cuts={0: 15.0, 1: 16.0, 2: 17.0})
    assert search(views_matter, Targets(db=30.0)).run().setting.sh_degree == 3
    plain = Trade(gains={"quick": -1.0}, cuts={0: 60.0, 1: 61.0, 2: 62.0})
    chosen = search(plain, Targets(db=30.0)).run().setting
    assert (chosen.sh_degree, chosen.repair) == (0, "none")


def test_all_targets_hold_at_once():
    targets = Targets(db=30.0, ms=20.0, mb=3.0)
    assert targets.missed(search(Trade(), targets).run().point) == []


@pytest.mark.parametrize(
    "targets, said",
    [(Targets(db=40.0, mb=0.5), "MB, more than 500 kB"), (Targets(db=40.0, ms=3.0), "a frame, more than 3 ms")],
)
def test_targets_that_exclude_one_another_name_the_obstacle(targets, said):
    with pytest.raises(BudgetError, match=f"no scene meets all targets: the smallest that reaches 40 dB .*{said}"):
        search(Trade(), targets).run()


@pytest.mark.parametrize("targets", [{}, {"db": 0.0}, {"ms": -1.0}, {"mb": float("nan")}, {"db": float("inf")}])
def test_targets_that_mean_nothing_are_refused(targets):
    with pytest.raises(BudgetError, match="--target-"):
        Targets(**targets)
