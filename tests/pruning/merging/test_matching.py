"""Disjoint pairs of neighbours."""

import math

import pytest
import torch

from making import assert_same_on_any_threads
from pointsplat_ns.pruning.merging import matching
from pointsplat_ns.pruning.merging.matching import KERNELS, cheapest_pairs

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def ring(n: int) -> torch.Tensor:
    """(n, 2) int32: the one before and the one after each, around."""
    here = torch.arange(n)
    return torch.stack([(here - 1) % n, (here + 1) % n], dim=1).to(torch.int32)


def test_pairs_are_disjoint_neighbours_and_no_more_than_asked_for():
    g = torch.Generator().manual_seed(0)
    n = 1000
    near = torch.randint(0, n, (n, 5), generator=g, dtype=torch.int32)
    costs = torch.rand(n, 5, generator=g)
    for most in (1, 50, 1000):
        first, second = cheapest_pairs(near, costs.clone(), most)
        both = torch.cat([first, second])
        assert len(both.unique()) == len(both) and 1 <= len(first) <= most
        assert all(j in near[i] or i in near[j] for i, j in zip(first.tolist(), second.tolist(), strict=True))


def test_the_cheapest_pair_of_all_is_the_first():
    costs = torch.full((10, 2), 1.0)
    costs[3, 1] = costs[4, 0] = 0.1
    first, second = cheapest_pairs(ring(10), costs, 1)
    assert {int(first), int(second)} == {3, 4}


def test_a_pair_costs_the_mean_of_its_two_costs():
    near, costs = ring(4), torch.full((4, 2), 1.0)
    costs[0, 1], costs[1, 0] = 0.0, 1.8  # 0.9 together: still less than the others
    assert {int(member) for member in torch.cat(cheapest_pairs(near, costs.clone(), 1))} == {0, 1}
    costs[1, 0] = 2.2
    assert {int(member) for member in torch.cat(cheapest_pairs(near, costs, 1))} != {0, 1}


def test_a_pair_of_which_only_one_is_a_neighbour_is_found():
    near = torch.tensor([[1], [2], [1]], dtype=torch.int32)
    first, second = cheapest_pairs(near, torch.tensor([[0.1], [5.0], [5.0]]), 1)
    assert (int(first), int(second)) == (0, 1)


def test_equal_costs_along_a_chain_yield_many_pairs_at_once():
    first, _ = cheapest_pairs(ring(1000), torch.ones(1000, 2), 1000)
    assert len(first) > 300


def test_pieces_give_the_same_as_the_whole(monkeypatch):
    g = torch.Generator().manual_seed(1)
    near, costs = torch.randint(0, 500, (500, 4), generator=g, dtype=torch.int32), torch.rand(500, 4, generator=g)
    whole = cheapest_pairs(near, costs, 500, compiled=False)
    monkeypatch.setattr(matching, "CHUNK", 37)
    assert all(torch.equal(a, b) for a, b in zip(whole, cheapest_pairs(near, costs, 500, compiled=False), strict=True))


@needs_compiler
@pytest.mark.parametrize("n", [1, 2, 300, 20_000])
def test_kernels_find_the_pairs_of_torch_to_the_bit_on_any_number_of_threads(n):
    """With neighbours that occur twice, or are none, and with costs that are equal, infinite or no numbers."""
    g = torch.Generator().manual_seed(n)
    near = torch.randint(0, n, (n, 6), generator=g, dtype=torch.int32)
    near[::3, 2], near[::5, 1] = near[::3, 4], torch.arange(n, dtype=torch.int32)[::5]
    costs = torch.randint(0, 9, (n, 6), generator=g) / 8
    costs[::7, 0], costs[::11, 3] = math.inf, math.nan
    for passes in (1, 6):
        torchs = cheapest_pairs(near, costs, n, passes, compiled=False)
        assert_same_on_any_threads(lambda passes=passes: cheapest_pairs(near, costs, n, passes, compiled=True))
        found = cheapest_pairs(near, costs, n, passes, compiled=True)
        assert all(torch.equal(a, b) for a, b in zip(found, torchs, strict=True)) and (len(torchs[0]) or n < 3)


def test_itself_is_no_neighbour_and_a_cost_that_is_no_number_is_no_pair():
    alone = torch.arange(3, dtype=torch.int32)[:, None]
    assert len(cheapest_pairs(alone, torch.zeros(3, 1), 3)[0]) == 0
    costs = torch.tensor([[math.nan, 1.0], [1.0, math.nan], [1.0, 1.0]])
    first, second = cheapest_pairs(ring(3), costs, 1)
    assert {int(first), int(second)} == {0, 1}
