"""Products with the Jacobian, and the steps made of them."""

from __future__ import annotations

from types import ModuleType

import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.compression.closeness import DenseReference
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import prune

UNITS = {"means": 4e-3, "scales": 0.1, "quats": 0.05, "opacities": 0.3, "features_dc": 0.1, "features_rest": 0.03}


@pytest.fixture(scope="module")
def steps(benchmark) -> ModuleType:
    return benchmark("second_order")


@pytest.fixture(scope="module")
def room(make_hollow_ball):
    return make_hollow_ball(1500, degree=1)


@pytest.fixture(scope="module")
def source(room):
    return ViewSource(room, given=sample_views(room, 40, 48, 36, seed=3))


def linear_in(steps, scene):
    """A scene around the origin, seen from four units away."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[48.0, 0.0, 24.0], [0.0, 48.0, 18.0], [0.0, 0.0, 1.0]])
    return steps.Linear(scene, list(ps.Views(viewmat[None], K[None], 48, 36, torch.full((3,), 0.5))))


@pytest.mark.parametrize("name", UNITS)
def test_both_products_are_with_the_same_jacobian(name, steps):
    """``J v . J v = v . J^T J v``."""
    scene = cloud(12)
    linear = linear_in(steps, scene)
    v = {name: UNITS[name] * torch.randn(getattr(scene, name).shape, generator=torch.Generator().manual_seed(0))}
    forward = linear.along(v, UNITS)
    squares = sum(float(picture.square().sum()) for picture in forward)
    # 5 %: a difference of pictures, in which alphas below 1/255 are not drawn
    assert squares > 0 and float((v[name] * linear.back(forward)[name]).sum()) == pytest.approx(squares, rel=0.05)


def test_the_estimated_diagonal_is_that_of_the_product(steps):
    """Of the opacity of one Gaussian, in the mean of many signs."""
    linear = linear_in(steps, cloud(1).replace(scales=torch.full((1, 3), -1.0)))
    exact = float(linear.along({"opacities": torch.ones(1, 1)}, UNITS)[0].square().sum())
    estimate = steps._diagonal(linear, torch.Generator().manual_seed(0), times=400)["opacities"]
    assert exact > 0 and float(estimate) == pytest.approx(exact, rel=0.2)


def test_both_ways_come_closer(steps, room, source):
    pruned = prune(room, 300, "merge")
    reference = DenseReference(room, source.compared())
    before = reference.psnr(pruned)[0]
    took, scene = next(steps.gauss_newton(pruned, room, source, 60.0, at_once=3, iterations=3))
    assert took > 0 and len(scene) == 300 and reference.psnr(scene)[0] > before + 0.2
    assert reference.psnr(steps.diagonal_newton(pruned, room, source, 12, 0.03))[0] > before + 0.2
