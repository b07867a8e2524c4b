"""The rule of alpha and transmittance against a loop over the Gaussians of one pixel."""

import math

import pytest
import torch

from pointsplat_ns.rasterizer.alpha import alphas_, is_clamped, is_drawn, last_transmittance, transmittances
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

LENGTHS = [1, 16, 63, 64, 65, 80, 160, 200]
"""Gaussians in front of one another: below and above what is scanned step by step, in whole groups and not."""


def random_log2(n, seed=0):
    """Logarithms of unclamped alphas: of a few the alpha is too low to be drawn, of a few above the maximum."""
    return 3.0 * torch.rand(2, n, 64, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 0.2 - 2.8


def by_definition(log2):
    """Transmittance behind the last Gaussian drawn, and the weight of each, of the pixels one by one."""
    weights = torch.zeros_like(log2)
    last = torch.ones_like(log2[:, 0])
    for tile in range(log2.shape[0]):
        for pixel in range(64):
            through = 1.0
            for k, power in enumerate(log2[tile, :, pixel].tolist()):
                alpha = min(ALPHA_MAX, 2.0**power)
                if alpha < ALPHA_MIN:
                    continue
                if through * (1 - alpha) <= TRANSMITTANCE_MIN:
                    break
                weights[tile, k, pixel] = alpha * through
                through *= 1 - alpha
            last[tile, pixel] = through
    return weights, last


@pytest.mark.parametrize("spread", [1.0, 4.0])
@pytest.mark.parametrize("n", LENGTHS)
def test_whole_chunks_follow_the_definition(n, spread):
    log2 = spread * random_log2(n)
    weights, last = by_definition(log2)
    alpha = alphas_(log2.clone(), ALPHA_MIN)
    through = transmittances(1 - alpha, torch.ones_like(alpha[:, 0]), alpha.new_empty(2, n + 1, 64))
    drawn = is_drawn(through[:, 1:], TRANSMITTANCE_MIN)
    # 1e-12: up to 200 factors in float64, in another order
    torch.testing.assert_close(alpha * drawn * through[:, :-1], weights, rtol=1e-12, atol=0)
    torch.testing.assert_close(last_transmittance(through, drawn), last, rtol=1e-12, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_exceeds_the_maximum_is_clamped_and_known_to_be(dtype):
    alpha = alphas_(torch.tensor([0.5, 0.998, 0.9995, 1.0, 3.0], dtype=dtype).log2(), ALPHA_MIN)
    assert float(alpha.max()) == pytest.approx(ALPHA_MAX, rel=1e-7)
    assert is_clamped(alpha).tolist() == [False, False, True, True, True]


def test_a_gaussian_without_opacity_is_not_drawn():
    assert alphas_(torch.tensor([-math.inf]), ALPHA_MIN).tolist() == [0.0]
