"""A scene that tests of views and budgets share."""

import math
from collections.abc import Callable

import pytest
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.view_sampling import sample_views
from pointsplat_ns.views import Views


@pytest.fixture(scope="session")
def make_hollow_ball() -> Callable[..., Gaussians]:
    """A function that makes the inside of a ball of radius 2 about (5, 0, 0), covered with opaque blobs, and an outlier
    far away."""

    def make(n: int = 1500, seed: int = 0, degree: int = 2) -> Gaussians:
        generator = torch.Generator().manual_seed(seed)
        place = torch.randn(n, 3, generator=generator)
        place = 2 * place / place.norm(dim=1, keepdim=True)
        scene = Gaussians(
            means=place + torch.tensor([5.0, 0.0, 0.0]),
            scales=torch.full((n, 3), math.log(0.12)) + 0.2 * torch.randn(n, 3, generator=generator),
            quats=torch.randn(n, 4, generator=generator),
            opacities=2 + torch.randn(n, 1, generator=generator),
            features_dc=torch.sin(2 * place) + 0.3 * torch.randn(n, 3, generator=generator),
            features_rest=0.03 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator),
        )
        scene.means[0] = 1e6
        return scene

    return make


@pytest.fixture(scope="package")
def hollow_ball(make_hollow_ball) -> Gaussians:
    """Shared by all tests here, so do not write to it."""
    return make_hollow_ball()


@pytest.fixture(scope="package")
def ball_views(hollow_ball) -> Views:
    """Four small views from within."""
    return sample_views(hollow_ball, 4, 64, 48)
