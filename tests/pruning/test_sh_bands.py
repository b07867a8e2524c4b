"""SH bands: the energy is what an integral over the sphere says, and what stays is untouched."""

import math

import pytest
import torch

from making import normal_scene
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import band_energies, cut_sh, energy_lost
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis


def test_energies_are_mean_squares_over_the_sphere():
    scene = normal_scene(20).to(torch.float64)
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(200_000, 3, generator=generator, dtype=torch.float64)
    basis = sh_basis(directions / directions.norm(dim=1, keepdim=True), 3)
    area = scene.stds.sort(dim=1).values[:, 1:].prod(dim=1)
    weights = scene.alphas * area / (scene.alphas * area).sum()
    for degree, found in enumerate(band_energies(scene), start=1):
        band = slice(degree**2, (degree + 1) ** 2)
        colors = torch.einsum("dk,nkc->ndc", basis[:, band], scene.sh[:, band])
        wanted = (weights * colors.square().mean(dim=(1, 2))).sum()
        assert found == pytest.approx(float(wanted), rel=0.01)  # 200,000 directions: 0.5 % of noise


def test_lost_shares_add_up():
    scene = normal_scene(20)
    energies = band_energies(scene)
    lost = [energy_lost(scene, degree) for degree in range(4)]
    assert lost[0] == pytest.approx(1.0) and lost[3] == 0.0
    assert lost[1] == pytest.approx((energies[1] + energies[2]) / sum(energies))
    assert lost[2] == pytest.approx(energies[2] / sum(energies))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_cutting_leaves_the_rest_bit_for_bit(degree):
    scene = normal_scene(20)
    cut = cut_sh(scene, degree)
    assert cut.sh_degree == degree
    assert torch.equal(cut.features_rest, scene.features_rest[:, : (degree + 1) ** 2 - 1])
    assert all(torch.equal(a, b) for (name, a), (_, b) in zip(cut.items(), scene.items(), strict=True) if name != "features_rest")  # fmt: skip # noqa: E501


def test_a_lower_degree_than_there_is_changes_nothing():
    assert cut_sh(normal_scene(20, 1), 3).sh_degree == 1 and energy_lost(normal_scene(20, 1), 2) == 0.0


@pytest.mark.parametrize("case", ["empty", "no colour", "invisible", "nan", "huge scales", "degree 0"])
def test_where_there_is_nothing_to_lose_nothing_is_lost(case):
    scene = normal_scene(20)
    scene = {
        "empty": lambda: Gaussians.empty(3),
        "no colour": lambda: scene.replace(features_rest=torch.zeros_like(scene.features_rest)),
        "invisible": lambda: scene.replace(opacities=torch.full_like(scene.opacities, -math.inf)),
        "nan": lambda: scene.map(lambda value: value * math.nan),
        "huge scales": lambda: scene.replace(scales=torch.full_like(scene.scales, 1e4)),
        "degree 0": lambda: normal_scene(20, 0),
    }[case]()
    lost = energy_lost(scene, 0)
    assert lost == pytest.approx(1.0) if case == "huge scales" else lost == 0.0


@pytest.mark.parametrize("degree", [-1, 4])
def test_a_degree_that_is_none_is_said(degree):
    for function in (cut_sh, energy_lost):
        with pytest.raises(BudgetError, match=f"SH degree is {degree}; expected 0 to 3"):
            function(normal_scene(20), degree)
