"""Members change to the group that they fit best."""

import pytest
import torch

from making import cloud
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.merging import MERGING
from pointsplat_ns.pruning.merging.covariance import covariances, unpack
from pointsplat_ns.pruning.merging.regrouping import Members, Moments, best_groups, group_moments

ALL = torch.arange(200)


def random_groups(scene: Gaussians, count: int) -> torch.Tensor:
    """Groups by chance, none empty."""
    group = torch.randint(count, (len(scene),), generator=torch.Generator().manual_seed(2))
    group[:count] = torch.arange(count)
    return group


def moments_of(scene: Gaussians, group: torch.Tensor, count: int) -> Moments:
    """Moments of groups of all."""
    return group_moments(Members.of(scene, ALL), group, count)


def after(scene: Gaussians, group: torch.Tensor, count: int) -> torch.Tensor:
    """The group that each fits best: the same by kernels and without them."""
    members, groups = Members.of(scene, ALL), moments_of(scene, group, count)
    found, torchs = (best_groups(members, group, groups, compiled=compiled) for compiled in (None, False))
    assert torch.equal(found, torchs)
    return found


def likelihood(scene: Gaussians, group: torch.Tensor, count: int) -> float:
    """Mean by mass of the expected log-density of the members under the Gaussian of their group."""
    groups = moments_of(scene, group, count)
    normal = torch.distributions.MultivariateNormal(groups.means, unpack(groups.cov))
    own = covariances(scene.scales.double(), scene.quats.double())
    log_density = torch.stack([normal.log_prob(mean[None].expand(count, 3)) for mean in scene.means.double()])
    within = (torch.linalg.inv(unpack(groups.cov))[group] * unpack(own)).sum((1, 2))
    fit = log_density.gather(1, group[:, None])[:, 0] - 0.5 * within
    return float((fit * Members.of(scene, ALL).masses).sum() / groups.mass.sum())


def test_moments_are_those_of_the_members_and_between_them():
    scene, group = cloud(200), random_groups(cloud(200), 7)
    groups = moments_of(scene, group, 7)
    masses = Members.of(scene, ALL).masses
    for number in range(7):
        these = (group == number).nonzero()[:, 0]
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
    scene, group = cloud(200), random_groups(cloud(200), 20)
    reached = [likelihood(scene, group, 20)]
    for _ in range(3):
        group = after(scene, group, 20)
        assert torch.equal(group.unique(), torch.arange(20))
        reached.append(likelihood(scene, group, 20))
    assert reached[1] > reached[0] + 0.5 and reached[2] > reached[1]


def test_a_member_in_the_wrong_group_changes_by_its_position_and_by_its_colour():
    scene = cloud(200)
    means, colours = scene.means.clone(), torch.zeros_like(scene.features_dc)
    side = ALL % 2
    means[:, 0] = 0.1 * means[:, 0] + 20.0 * side
    apart = scene.replace(means=means)
    group = side.clone()
    group[7] = 0
    assert torch.equal(after(apart, group, 2), side)
    colours[side == 1] = 3.0
    mixed = scene.replace(features_dc=colours)  # in one place, of two colours
    assert torch.equal(after(mixed, group, 2), side)


@pytest.mark.parametrize("unit", [1e-15, 1.0, 1e12])
def test_the_unit_of_length_does_not_matter(unit):
    scene, group = cloud(200).to(torch.float64), random_groups(cloud(200), 20)
    scaled = scene.replace(means=scene.means * unit, scales=scene.scales + torch.tensor(unit).log())
    expected, found = (after(s, group, 20) for s in (scene, scaled))
    assert torch.equal(found, expected) and not torch.equal(found, group)


@pytest.mark.parametrize("count", [1, 2, MERGING.regrouping_candidates - 1])
def test_there_may_be_fewer_groups_than_candidates(count):
    scene, group = cloud(200), random_groups(cloud(200), count)
    assert torch.equal(after(scene, group, count).unique(), torch.arange(count))
