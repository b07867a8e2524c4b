"""Members of merged Gaussians go to the group that they fit best."""

from __future__ import annotations

import pytest
import torch

from making import cloud
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.covariance import covariances, unpack
from pointsplat_ns.pruning.regrouping import CANDIDATES, Moments, masses_of, moments, regrouped

EVERYBODY = torch.arange(200)


def placed(scene: Gaussians, count: int) -> torch.Tensor:
    """Groups by chance, none empty."""
    place = torch.randint(count, (len(scene),), generator=torch.Generator().manual_seed(2))
    place[:count] = torch.arange(count)
    return place


def moments_of(scene: Gaussians, place: torch.Tensor, count: int) -> Moments:
    """Moments of groups of everybody."""
    return moments(scene, EVERYBODY, masses_of(scene, EVERYBODY), place, count)


def after(scene: Gaussians, place: torch.Tensor, count: int) -> torch.Tensor:
    """Where everybody goes."""
    return regrouped(scene, EVERYBODY, masses_of(scene, EVERYBODY), place, moments_of(scene, place, count))


def likelihood(scene: Gaussians, place: torch.Tensor, count: int) -> float:
    """Mean by mass of the expected log-density of the members under the Gaussian of their group."""
    groups = moments_of(scene, place, count)
    normal = torch.distributions.MultivariateNormal(groups.means, unpack(groups.cov))
    own = covariances(scene.scales.double(), scene.quats.double())
    log_density = torch.stack([normal.log_prob(mean[None].expand(count, 3)) for mean in scene.means.double()])
    within = (torch.linalg.inv(unpack(groups.cov))[place] * unpack(own)).sum((1, 2))
    fit = log_density.gather(1, place[:, None])[:, 0] - 0.5 * within
    return float((fit * masses_of(scene, EVERYBODY)).sum() / groups.mass.sum())


def test_moments_are_those_of_the_members_and_between_them():
    scene, place = cloud(200), placed(cloud(200), 7)
    groups = moments_of(scene, place, 7)
    masses = masses_of(scene, EVERYBODY)
    for number in range(7):
        these = (place == number).nonzero()[:, 0]
        weights = masses[these] / masses[these].sum()
        means = scene.means[these].double()
        centre = weights @ means
        apart = means - centre
        own = unpack(covariances(scene.scales[these].double(), scene.quats[these].double()))
        spread = (weights[:, None, None] * (own + apart[:, :, None] * apart[:, None])).sum(0)
        torch.testing.assert_close(groups.means[number], centre)
        torch.testing.assert_close(unpack(groups.cov)[number], spread)
        torch.testing.assert_close(groups.shares[these], weights)
    torch.testing.assert_close(groups.mass.sum(), masses.sum())


def test_members_fit_better_each_time_and_no_group_is_left_empty():
    scene, place = cloud(200), placed(cloud(200), 20)
    reached = [likelihood(scene, place, 20)]
    for _ in range(3):
        place = after(scene, place, 20)
        assert torch.equal(place.unique(), torch.arange(20))
        reached.append(likelihood(scene, place, 20))
    assert reached[1] > reached[0] + 0.5 and reached[2] > reached[1]


def test_a_stray_member_goes_where_it_lies_and_where_its_colour_is():
    scene = cloud(200)
    means, colours = scene.means.clone(), torch.zeros_like(scene.features_dc)
    side = EVERYBODY % 2
    means[:, 0] = 0.1 * means[:, 0] + 20.0 * side
    apart = scene.replace(means=means)
    place = side.clone()
    place[7] = 0
    assert torch.equal(after(apart, place, 2), side)
    colours[side == 1] = 3.0
    mixed = scene.replace(features_dc=colours)  # in one place, of two colours
    assert torch.equal(after(mixed, place, 2), side)


@pytest.mark.parametrize("unit", [1e-15, 1.0, 1e12])
def test_the_unit_of_length_does_not_matter(unit):
    scene, place = cloud(200).to(torch.float64), placed(cloud(200), 20)
    scaled = scene.replace(means=scene.means * unit, scales=scene.scales + torch.tensor(unit).log())
    expected, found = (after(s, place, 20) for s in (scene, scaled))
    assert torch.equal(found, expected) and not torch.equal(found, place)


@pytest.mark.parametrize("what", ["points", "one place", "transparent", "needles", "huge", "colours"])
def test_extremes_give_groups_and_finite_moments(what):
    scene, place = cloud(200), placed(cloud(200), 20)
    changed = {
        "points": {"scales": torch.full_like(scene.scales, -60.0)},
        "one place": {"means": torch.zeros_like(scene.means), "scales": torch.full_like(scene.scales, -60.0)},
        "transparent": {"opacities": torch.full_like(scene.opacities, -300.0)},
        "needles": {"scales": scene.scales + torch.tensor([20.0, -20.0, -20.0])},
        "huge": {"means": scene.means * 1e30, "scales": torch.full_like(scene.scales, 60.0)},
        "colours": {"features_dc": scene.features_dc * 1e30},
    }[what]
    scene = scene.replace(**changed)
    groups = moments_of(scene, place, 20)
    assert all(bool(values.isfinite().all()) for values in (groups.means, groups.cov, groups.colours, groups.shares))
    torch.testing.assert_close(torch.zeros(20).double().index_add_(0, place, groups.shares), torch.ones(20).double())
    assert torch.equal(after(scene, place, 20).unique(), torch.arange(20))


@pytest.mark.parametrize("count", [1, 2, CANDIDATES - 1])
def test_fewer_groups_than_a_member_is_shown(count):
    scene, place = cloud(200), placed(cloud(200), count)
    assert torch.equal(after(scene, place, count).unique(), torch.arange(count))
