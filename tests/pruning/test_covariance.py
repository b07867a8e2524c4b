"""Projections of covariances at the extremes: areas that cancel to nothing."""

from __future__ import annotations

import math

import pytest
import torch

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.pruning.covariance import flat_area, overlap, pack, unpack


@pytest.mark.parametrize("length", [1.0, 1e6, 1e12, 1e30])
@pytest.mark.parametrize("width", [1.0, 1e-3, 1e-9, 0.0])
def test_no_overlap_exceeds_the_smaller_shadow(length, width):
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
    assert (found <= (1 + 1e-6) * torch.minimum(flat_area(flat), flat_area(0.5 * flat))).all()


def test_the_overlap_of_equal_round_shadows_is_the_closed_form():
    flat = torch.tensor([[4.0, 0.0, 4.0]], dtype=torch.float64)  # standard deviation 2, area 4
    u, v = torch.tensor([[3.0], [1.0]], dtype=torch.float64)
    # areas 4 * 4 / 8, and a squared distance of 10 over the summed variance of 8
    assert overlap(flat, flat, u, v).item() == pytest.approx(
        2 * torch.tensor(-10 / 16).double().exp().item(), rel=1e-12
    )


def test_the_overlap_of_skewed_shadows_is_the_integral_of_their_product():
    flat = torch.tensor([[3.0, 1.2, 2.0], [1.0, -0.5, 2.5]], dtype=torch.float64)
    apart = torch.tensor([0.9, -1.4], dtype=torch.float64)
    axis = torch.linspace(-12, 12, 481, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1)

    def splat(row: torch.Tensor, at: torch.Tensor | float) -> torch.Tensor:
        inverse = torch.linalg.inv(row[[0, 1, 1, 2]].view(2, 2))
        return torch.exp(-0.5 * ((grid - at) @ inverse * (grid - at)).sum(-1))

    integral = float((splat(flat[0], 0.0) * splat(flat[1], apart)).sum()) * 0.05**2 / (2 * math.pi)
    u, v = apart[:, None]
    assert overlap(flat[:1], flat[1:], u, v).item() == pytest.approx(integral, rel=1e-9)


def test_six_numbers_are_those_of_the_matrix():
    six = torch.arange(1.0, 7.0)[None]
    matrix = unpack(six)
    assert matrix[0].tolist() == [[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]]
    assert torch.equal(pack(matrix), six)


def test_far_outliers_on_a_line_are_merged_to_one():
    """Found by search among random scenes: the area of a merged needle, 1e10 units long, cancelled to 0."""
    generator = torch.Generator().manual_seed(111)
    scene = ball(int(torch.randint(2, 30, (1,), generator=generator)), degree=0, seed=111)
    far = 10 ** float(torch.rand(1, generator=generator) * 12)
    count = int(torch.randint(1, len(scene) + 1, (1,), generator=generator))
    torch.randn(3, generator=generator)
    scene.means[:count] = torch.tensor([0.0, 0.0, 1.0]) * far * torch.randn(count, 1, generator=generator)
    kept = ps.prune(scene, keep=1)
    assert len(kept) == 1 and all(value.isfinite().all() for value in kept.tensors())
