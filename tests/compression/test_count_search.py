"""The search for a count: it meets the target, ends near it, and needs few tries, whatever the measure is like."""

import math

import pytest

from pointsplat_ns.compression.budget_search import SearchSettings, find_count

MOST = 100_000
MEASURES = {
    "straight over the logarithm": lambda count: 40 + 6 * math.log(count / MOST),
    "bent": lambda count: 40 * (count / MOST) ** 0.2,
    "proportional": lambda count: math.log(16 * count + 500),
    "a time with a share that is always there": lambda count: math.log(5.0 + count / 1000),
    "in one step": lambda count: 20.0 if count < 12_345 else 40.0,
    "endless for the whole": lambda count: math.inf if count == MOST else 30 + math.log(count / MOST),
}


def searched(measure, target, at_least, first=30_000, **options):
    tried = {}

    def measured(count):
        assert 1 <= count <= MOST and count not in tried, "measured twice, or out of bounds"
        tried[count] = measure(count)
        return tried[count]

    return find_count(measured, target, at_least, first, MOST, **options), tried


@pytest.mark.parametrize("at_least", [True, False])
@pytest.mark.parametrize("share", [0.001, 0.07, 0.3, 0.5, 0.99])
@pytest.mark.parametrize("name", MEASURES)
def test_the_count_meets_the_target_and_a_neighbour_that_was_tried_does_not(name, share, at_least):
    measure = MEASURES[name]
    target = measure(round(share * MOST))
    found, tried = searched(measure, target, at_least)
    meets = (lambda value: value >= target) if at_least else (lambda value: value <= target)
    if found.count is None:
        assert not any(map(meets, tried.values())) and (MOST if at_least else 1) in tried
        return
    assert meets(tried[found.count])
    missed = [count for count, value in tried.items() if not meets(value)]
    low, high = (max(missed, default=0), found.count) if at_least else (found.count, min(missed, default=MOST + 1))
    assert high <= max(low, 1) * SearchSettings().precision or high - low == 1
    assert len(tried) <= 16


def test_a_known_slope_saves_tries():
    measure = MEASURES["straight over the logarithm"]
    blind, told = (len(searched(measure, 28.0, True, slope=slope)[1]) for slope in (None, 6.0))
    assert told < blind


def test_a_count_near_enough_to_the_target_ends_the_search():
    near = SearchSettings(tolerance=0.1)
    found, tried = searched(MEASURES["straight over the logarithm"], 28.0, True, slope=6.0, settings=near)
    assert 28.0 <= tried[found.count] <= 28.1 and len(tried) <= 3


def test_tries_are_limited_once_one_meets_the_target():
    limited = SearchSettings(tries=2)
    assert len(searched(MEASURES["bent"], 20.0, True, settings=limited)[1]) == 2
    found, tried = searched(MEASURES["bent"], 39.9, True, first=10, settings=limited)
    assert found.count is not None and len(tried) > 2


def test_bounds_are_tried_before_it_gives_up():
    found, tried = searched(MEASURES["bent"], 41.0, True)
    assert found.count is None and MOST in tried
    found, tried = searched(MEASURES["bent"], 1.0, False, least=100)
    assert found.count is None and min(tried) == 100
