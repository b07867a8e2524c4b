"""Neighbours and Morton order."""

import pytest
import torch

from pointsplat_ns.geometry import neighbours
from pointsplat_ns.geometry.neighbours import NearestOf, nearest, other_neighbours
from pointsplat_ns.geometry.transforms import curve_keys


def points(n, d=3, seed=0, dtype=torch.float32):
    return torch.randn(n, d, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def by_brute_force(where, k):
    apart = (where.double()[:, None] - where.double()).norm(dim=2)
    return apart.sort(dim=1).values[:, :k], apart.sort(dim=1).indices[:, :k]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("k", [1, 2, 9])
def test_the_nearest_are_those_of_brute_force(k, dtype):
    where = points(100, dtype=dtype)
    distances, indices = nearest(where, k)
    wanted_distances, wanted_indices = by_brute_force(where, k)
    assert torch.equal(indices, wanted_indices)
    torch.testing.assert_close(distances, wanted_distances, rtol=1e-12, atol=0)  # both in float64


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_other_neighbours_are_the_nearest_without_the_point_itself(monkeypatch, scale):
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 300)  # several pieces
    where = scale * points(1000).double()
    assert torch.equal(other_neighbours(where, 8).long(), by_brute_force(where, 9)[1][:, 1:])


def test_a_crowd_of_coincident_points_is_linked_all_the_way_through():
    """Their nearest ones alone may be the same few, from which no other is reached."""
    near = other_neighbours(torch.zeros(500, 3, dtype=torch.float64), 4)
    reached = torch.zeros(500, dtype=torch.bool)
    reached[0] = True
    for _ in range(500):
        reached[near[reached].long().flatten()] = True
    assert bool(reached.all())


@pytest.mark.parametrize("n", [1, 7, 600])
def test_the_nearest_of_other_places_are_those_of_brute_force(n):
    where = points(n).double() * torch.tensor([10.0, 1.0, 0.1])
    where[: n // 3] = where[: n // 3].round()  # many coincide in some coordinates
    queries = where + 0.2 * points(n, seed=1).double()
    near = NearestOf(where, 6)(queries)
    distances = (queries[:, None] - where[near]).square().sum(2)
    wanted = (queries[:, None] - where).square().sum(2).sort(dim=1).values[:, :6]
    torch.testing.assert_close(distances, wanted, rtol=1e-14, atol=0)  # float64, in another order
    assert all(len(row.unique()) == min(6, n) for row in near)


def test_the_curve_interleaves_the_bits_of_the_grid():
    generator = torch.Generator().manual_seed(1)
    cells = torch.rand(200, 3, generator=generator)
    grid = (cells * (2**20 - 1)).long().tolist()
    wanted = [
        sum(((value >> bit) & 1) << (3 * bit + 2 - axis) for bit in range(20) for axis, value in enumerate(point))
        for point in grid
    ]
    assert curve_keys(cells).tolist() == wanted


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_where_there_are_fewer_others_a_points_own_index_stands_for_none(n):
    near = other_neighbours(points(n).double(), 3)
    assert near.shape == (n, 3) and near.dtype == torch.int32 and nearest(points(n), 9)[0].shape == (n, n)
    for own, row in enumerate(near.tolist()):
        assert sorted(row[: n - 1]) == [other for other in range(n) if other != own] and set(row[n - 1 :]) == {own}
