"""Covariances and their projections, also at the extremes, where areas cancel to nothing."""

import math

import pytest
import torch

from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.pruning.merging.covariance import (
    covariances,
    overlap,
    plane_axes,
    projected,
    projected_area,
    rms_area,
    thinnest_axes,
)


def test_the_area_is_the_root_mean_square_over_directions():
    g = torch.Generator().manual_seed(3)
    six = covariances(torch.randn(1, 3, generator=g).double(), torch.randn(1, 4, generator=g).double())
    ways = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=g).double(), dim=1)
    areas = projected_area(projected(six.expand(len(ways), 6), *plane_axes(ways)))
    assert float(rms_area(six)) == pytest.approx(float(areas.square().mean().sqrt()), rel=0.01)  # 200,000 samples


def test_the_thinnest_axis_is_that_of_least_variance():
    g = torch.Generator().manual_seed(5)
    logs = torch.tensor([-1.0, -2.0, -6.0]).repeat(50, 1)
    quats = torch.randn(50, 4, generator=g).double()
    cosine = (thinnest_axes(covariances(logs.double(), quats)) * rotation_matrices(quats)[:, :, 2]).sum(1).abs()
    assert float(cosine.min()) > 0.9999


@pytest.mark.parametrize("length", [1.0, 1e6, 1e12, 1e30])
@pytest.mark.parametrize("width", [1.0, 1e-3, 1e-9, 0.0])
def test_no_overlap_exceeds_the_smaller_area(length, width):
    """Of needles along one direction, whose areas are lost to rounding as soon as they are long enough."""
    generator = torch.Generator().manual_seed(0)
    angle = torch.rand(200, generator=generator, dtype=torch.float64) * 7
    along, across = torch.stack([angle.cos(), angle.sin()]), torch.stack([-angle.sin(), angle.cos()])
    flat = torch.stack(
        [length**2 * along[i] * along[j] + width**2 * across[i] * across[j] for i, j in ((0, 0), (0, 1), (1, 1))], 1
    )
    u, v = along * length * torch.rand(200, generator=generator, dtype=torch.float64)
    found = overlap(flat, 0.5 * flat, u, v)
    assert found.isfinite().all() and (found >= 0).all()
    # 1e-6: the areas themselves are rounded
    assert (found <= (1 + 1e-6) * torch.minimum(projected_area(flat), projected_area(0.5 * flat))).all()


@pytest.mark.parametrize(
    ("first", "second", "apart"),
    [((4.0, 0.0, 4.0), (4.0, 0.0, 4.0), (3.0, 1.0)), ((3.0, 1.2, 2.0), (1.0, -0.5, 2.5), (0.9, -1.4))],
)
def test_the_overlap_is_the_integral_of_the_product(first, second, apart):
    axis = torch.linspace(-24, 24, 961, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1)
    first, second, apart = (torch.tensor(values, dtype=torch.float64) for values in (first, second, apart))

    def splat(flat: torch.Tensor, at: torch.Tensor | float) -> torch.Tensor:
        inverse = torch.linalg.inv(flat[[0, 1, 1, 2]].view(2, 2))
        return torch.exp(-0.5 * ((grid - at) @ inverse * (grid - at)).sum(-1))

    integral = float((splat(first, 0.0) * splat(second, apart)).sum()) * 0.05**2 / (2 * math.pi)
    u, v = apart[:, None]
    assert overlap(first[None], second[None], u, v).item() == pytest.approx(integral, rel=1e-9)
