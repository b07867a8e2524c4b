"""Cutting SH bands, and the energy that is lost by it."""

import math

import pytest
import torch

from making import normal_scene
from pointsplat_ns.pruning import band_energies, cut_sh, energy_lost
from pointsplat_ns.rendering.spherical_harmonics import sh_basis
from pointsplat_ns.scene.gaussians import Gaussians


def test_energies_are_mean_squares_over_the_sphere_and_lost_shares_add_up():
    scene = normal_scene(20).to(torch.float64)
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(
        torch.randn(20_000, 3, generator=generator, dtype=torch.float64), dim=1
    )
    basis = sh_basis(directions, 3)
    area = scene.stds.sort(dim=1).values[:, 1:].prod(dim=1)
    weights = scene.alphas * area / (scene.alphas * area).sum()
    energies = band_energies(scene)
    for degree, found in enumerate(energies, start=1):
        band = slice(degree**2, (degree + 1) ** 2)
        colors = torch.einsum("dk,nkc->ndc", basis[:, band], scene.sh[:, band])
        wanted = (weights * colors.square().mean(dim=(1, 2))).sum()
        assert found == pytest.approx(float(wanted), rel=0.03)  # 20,000 directions: 1.5 % of noise
    for degree in range(4):
        assert energy_lost(scene, degree) == pytest.approx(sum(energies[degree:]) / sum(energies))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_cutting_leaves_the_rest_bit_for_bit(degree):
    scene = normal_scene(20)
    cut = cut_sh(scene, degree)
    assert cut.sh_degree == degree
    for (name, ours), (_, whole) in zip(cut.items(), scene.items(), strict=True):
        assert torch.equal(ours, whole[:, : ours.shape[1]]), name


@pytest.mark.parametrize(
    "case", ["empty", "no colour", "invisible", "nan", "huge scales", "larger scales", "degree 0"]
)
def test_where_there_is_nothing_to_lose_nothing_is_lost(case):
    scene = normal_scene(20)
    scene = {
        "empty": lambda: Gaussians.empty(3),
        "no colour": lambda: scene.replace(features_rest=torch.zeros_like(scene.features_rest)),
        "invisible": lambda: scene.replace(opacities=torch.full_like(scene.opacities, -math.inf)),
        "nan": lambda: scene.map(lambda value: value * math.nan),
        "huge scales": lambda: scene.replace(scales=torch.full_like(scene.scales, 88.0)),
        "larger scales": lambda: scene.replace(
            scales=torch.full_like(scene.scales, 1e4)
        ),  # are not drawn
        "degree 0": lambda: normal_scene(20, 0),
    }[case]()
    lost = energy_lost(scene, 0)
    assert lost == pytest.approx(1.0) if case == "huge scales" else lost == 0.0
