"""Nearest neighbours against brute force."""

import pytest
import torch

from making import assert_same_on_any_threads
from pointsplat_ns.geometry import neighbours
from pointsplat_ns.geometry.neighbours import KERNELS, PointTree, nearest, nearest_of, other_neighbours

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)
compiled_or_not = pytest.mark.parametrize("compiled", [pytest.param(None, marks=needs_compiler), False])


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


@pytest.mark.parametrize("n", [1, 2, 5])
def test_of_few_points_all_are_given(n):
    distances, indices = nearest(points(n), 9)
    assert distances.shape == indices.shape == (n, n)
    assert (indices.sort(dim=1).values == torch.arange(n)).all()


def test_no_points_have_no_neighbours():
    distances, indices = nearest(points(0), 3)
    assert len(distances) == len(indices) == 0


def test_the_types_do_not_depend_on_the_number_of_points():
    for n in (0, 1, 10):
        distances, indices = nearest(points(n), 3)
        assert (distances.dtype, indices.dtype) == (torch.float64, torch.int64)


def test_points_in_a_graph_are_taken():
    assert nearest(points(10).requires_grad_(), 2)[1].shape == (10, 2)


@compiled_or_not
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_other_neighbours_are_the_nearest_without_the_point_itself(monkeypatch, compiled, scale):
    monkeypatch.setattr(neighbours, "TREE", neighbours.TreeSettings(queries_at_once=300))  # several pieces
    where = scale * points(1000).double()
    assert torch.equal(other_neighbours(where, 8, compiled).long(), by_brute_force(where, 9)[1][:, 1:])


@compiled_or_not
@pytest.mark.parametrize("n", [1, 2, 5])
def test_where_there_are_few_others_the_rest_is_the_point_itself(n, compiled):
    near = other_neighbours(points(n).double(), 8, compiled)
    others = (near != torch.arange(n)[:, None]).sum(1)
    assert near.shape == (n, 8) and others.tolist() == [n - 1] * n


@compiled_or_not
def test_a_crowd_of_coincident_points_is_linked_all_the_way_through(compiled):
    """Their nearest ones alone may be the same few, from which no other is reached."""
    near = other_neighbours(torch.zeros(500, 3, dtype=torch.float64), 4, compiled)
    reached = torch.zeros(500, dtype=torch.bool)
    reached[0] = True
    for _ in range(500):
        reached[near[reached].long().flatten()] = True
    assert bool(reached.all())


@compiled_or_not
def test_points_beside_a_crowd_keep_their_own_neighbours(compiled):
    crowd, apart = torch.zeros(50, 3), 10 + points(100)
    where = torch.cat([crowd, apart]).double()
    near = other_neighbours(where, 4, compiled)
    assert torch.equal(near[50:].long(), nearest(where, 5)[1][50:, 1:])


@compiled_or_not
@pytest.mark.parametrize("n", [1, 7, 8, 9, 64, 65, 600, 5000])
def test_the_nearest_of_other_places_are_those_of_brute_force(n, compiled):
    where = points(n).double() * torch.tensor([10.0, 1.0, 0.1])
    where[: n // 3] = where[: n // 3].round()  # many coincide in some coordinates
    queries = where + 0.2 * points(n, seed=1).double()
    near = nearest_of(where, queries, torch.randint(n, (n,), generator=torch.Generator().manual_seed(2)), 6, compiled)
    distances = (queries[:, None] - where[near.long()]).square().sum(2)
    wanted = (queries[:, None] - where).square().sum(2).sort(dim=1).values[:, :6]
    torch.testing.assert_close(distances, wanted, rtol=1e-14, atol=0)  # float64, in another order
    assert all(len(row.unique()) == min(6, n) for row in near)


@needs_compiler
@pytest.mark.parametrize("n", [1, 8, 9, 600, 5000])
def test_a_tree_holds_each_point_once(n):
    assert torch.equal(PointTree(points(n).double()).order.sort().values, torch.arange(n))


@needs_compiler
def test_any_number_of_threads_finds_the_same_neighbours():
    where = points(20_000).double()
    assert_same_on_any_threads(
        lambda: [other_neighbours(where, 6), PointTree(where).nearest(where, torch.zeros(20_000, dtype=torch.int64), 3)]
    )
