"""Nearest neighbours against brute force."""

import pytest
import torch

from pointsplat_ns.geometry.neighbours import nearest, nearest_and_walk


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
    distances, indices, walk = nearest_and_walk(points(0), 3)
    assert len(distances) == len(indices) == len(walk) == 0


def test_the_types_do_not_depend_on_the_number_of_points():
    for n in (0, 1, 10):
        distances, indices, walk = nearest_and_walk(points(n), 3)
        assert (distances.dtype, indices.dtype, walk.dtype) == (torch.float64, torch.int64, torch.int64)


def test_points_in_a_graph_are_taken():
    assert nearest(points(10).requires_grad_(), 2)[1].shape == (10, 2)


def test_the_walk_visits_every_point_once():
    assert torch.equal(nearest_and_walk(points(1000), 2)[2].sort().values, torch.arange(1000))


def test_the_walk_stays_near():
    where = points(2000)
    walk = where[nearest_and_walk(where, 2)[2]]
    step, any_two = walk.diff(dim=0).norm(dim=1).mean(), (walk - walk.flip(0)).norm(dim=1).mean()
    assert step < any_two / 2
