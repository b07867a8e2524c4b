"""Nearest neighbours, by each of three trees."""

import pytest
import torch

from pointsplat_ns.geometry import box_tree, neighbours
from pointsplat_ns.geometry.neighbours import NearestOf, nearest, other_neighbours
from pointsplat_ns.system.kernels import KERNELS
from pointsplat_ns.system.threads import fixed_threads


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


@pytest.fixture(params=["kernels", "scipy", "torch"])
def tree(request, monkeypatch):
    """Each of the trees; of torch's, in several pieces, which are halved."""
    if request.param == "kernels":
        if not KERNELS.usable(None):
            pytest.skip(KERNELS.why_missing)
    elif request.param == "scipy":
        monkeypatch.setattr(neighbours, "_tree_of", lambda points, k: neighbours._ScipyTree(points))
    else:
        monkeypatch.setattr(neighbours, "_tree_of", box_tree.BoxTree)
        monkeypatch.setattr(box_tree.BoxTree, "PAIRS_AT_ONCE", 400)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_other_neighbours_are_the_nearest_without_the_point_itself(monkeypatch, scale, tree):
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 300)  # several pieces
    where = scale * points(1000).double()
    assert torch.equal(other_neighbours(where, 8).long(), by_brute_force(where, 9)[1][:, 1:])


def test_a_crowd_of_coincident_points_is_linked_all_the_way_through(tree):
    """Their nearest ones alone may be the same few, from which no other is reached."""
    near = other_neighbours(torch.zeros(500, 3, dtype=torch.float64), 4)
    reached = torch.zeros(500, dtype=torch.bool)
    reached[0] = True
    for _ in range(500):
        reached[near[reached].long().flatten()] = True
    assert bool(reached.all())


@pytest.mark.parametrize("n", [1, 7, 600])
def test_the_nearest_of_other_places_are_those_of_brute_force(n, tree):
    where = points(n).double() * torch.tensor([10.0, 1.0, 0.1])
    where[: n // 3] = where[: n // 3].round()  # many coincide in some coordinates
    queries = where + 0.2 * points(n, seed=1).double()
    near = NearestOf(where, 6)(queries)
    distances = (queries[:, None] - where[near]).square().sum(2)
    wanted = (queries[:, None] - where).square().sum(2).sort(dim=1).values[:, :6]
    torch.testing.assert_close(distances, wanted, rtol=1e-14, atol=0)  # float64, in another order
    assert all(len(row.unique()) == min(6, n) for row in near)


def test_each_tree_is_exact_for_any_distribution(tree):
    dense = points(2000, dtype=torch.float64)
    g = torch.Generator().manual_seed(1)
    for where in (
        dense[:, :1] * torch.tensor([1.0, 2.0, 3.0]),  # a line
        torch.cat([dense, 1e7 + dense[:3]]),  # outliers, fewer than neighbours
        torch.cat([1e-6 * dense, dense, dense[:1].expand(900, 3)]),
        dense / torch.rand(2000, 1, generator=g) ** 3,
    ):
        found = neighbours._tree_of(where, 7).nearest(where, 7)[0]
        wanted = by_brute_force(where, 7)[0]
        # float64, in another order
        torch.testing.assert_close(found, wanted, rtol=1e-14, atol=0)


def test_any_number_of_threads_finds_the_same_neighbours():
    where = points(9000, seed=2).double().round(decimals=1)  # many coincide
    found = []
    for count in (1, 3):
        with fixed_threads(count):
            found.append(other_neighbours(where, 6))
    assert torch.equal(*found)


def test_more_neighbours_than_the_kernel_keeps_are_found_too():
    where = points(400)
    distances, _ = nearest(where, 40)
    torch.testing.assert_close(distances, by_brute_force(where, 40)[0], rtol=1e-12, atol=0)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_where_there_are_fewer_others_a_points_own_index_stands_for_none(n, tree):
    near = other_neighbours(points(n).double(), 3)
    assert (
        near.shape == (n, 3)
        and near.dtype == torch.int32
        and nearest(points(n), 9)[0].shape == (n, n)
    )
    for own, row in enumerate(near.tolist()):
        assert sorted(row[: n - 1]) == [other for other in range(n) if other != own] and set(
            row[n - 1 :]
        ) == {own}
