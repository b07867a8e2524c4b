"""Pairs, what they become, and members that change their group."""

import math

import pytest
import torch

from making import cloud
from pointsplat_ns.pruning.merging import MERGING
from pointsplat_ns.pruning.merging.covariance import covariances, rms_area, unpack
from pointsplat_ns.pruning.merging.pairs import cheapest_pairs, replace_pairs
from pointsplat_ns.pruning.merging.regrouping import Members, Moments, best_groups, group_moments
from pointsplat_ns.pruning.merging.state import Participants, State, initial_state
from pointsplat_ns.scene.gaussians import Gaussians


def state_of(scene: Gaussians) -> State:
    """The state before the first round, each Gaussian with another visibility weight."""
    n = len(scene)
    participants = Participants(scene, torch.arange(n), torch.zeros(3, dtype=torch.float64), 1.0)
    return initial_state(participants, torch.linspace(0.1, 1, n))


def extremes(n: int, unit: float) -> Gaussians:
    """Needles, disks and balls, near each other and far apart, from nearly transparent to
    opaque."""
    g = torch.Generator().manual_seed(3)
    return Gaussians(
        means=unit
        * torch.randn(n, 3, generator=g)
        * 10 ** torch.empty(n, 1).uniform_(-3, 1, generator=g),
        scales=math.log(unit) + torch.empty(n, 3).uniform_(-4, 4, generator=g),
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.empty(n, 1).uniform_(-30, 30, generator=g),
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.zeros(n, 0, 3),
    )


def test_a_replacement_has_the_moments_of_its_pair_and_is_finite():
    """Moments by mass, opacity times area; of pairs so faint that the area does not grow."""
    scene = cloud(40).replace(opacities=torch.full((40, 1), -3.0))
    state = state_of(scene)
    pairs = torch.randperm(40)[:30].view(2, 15)
    after, merged = replace_pairs(state, *pairs, MERGING)
    rows = merged.place[pairs[0]]
    assert torch.equal(rows, merged.place[pairs[1]]) and len(merged.place.unique()) == 25
    mass = (state.alphas * rms_area(state.cov.double()))[pairs]
    w = mass / mass.sum(0)
    torch.testing.assert_close(merged.shares[pairs], w.float())
    mean = (w[:, :, None] * state.means[pairs]).sum(0)
    apart = state.means[pairs] - mean
    spread = (
        unpack(state.cov.double()[pairs.flatten()]).view(2, 15, 3, 3)
        + apart[..., None] * apart[..., None, :]
    )
    torch.testing.assert_close(after.means[rows].double(), mean, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(
        unpack(after.cov)[rows].double(), (w[..., None, None] * spread).sum(0), rtol=1e-5, atol=1e-7
    )
    torch.testing.assert_close(
        after.colours[rows].double(),
        (w[:, :, None] * state.colours[pairs]).sum(0),
        rtol=1e-5,
        atol=1e-6,
    )
    assert (
        torch.equal(after.counts[rows], torch.full((15,), 2, dtype=torch.int32))
        and int(after.counts.sum()) == 40
    )
    for unit in (1e-14, 1.0, 1e14):
        after, _ = replace_pairs(
            state_of(extremes(2000, unit)), *torch.arange(1400).view(2, 700), MERGING
        )
        assert bool(after.alphas.isfinite().all()) and bool(after.cov.isfinite().all())


@pytest.mark.parametrize("scene", [cloud(2000), extremes(2000, 1.0)])
def test_a_state_in_float32_becomes_what_one_in_float64_becomes(scene):
    everyone = Participants(scene, torch.arange(2000), torch.zeros(3, dtype=torch.float64), 1.0)
    found = []
    for dtype in (torch.float32, torch.float64):
        state = initial_state(everyone, torch.ones(2000), dtype=dtype)
        shares = []
        for _ in range(4):
            pairs = torch.arange(len(state)).view(2, -1)
            state, merged = replace_pairs(state, *pairs, MERGING)
            shares.append(merged.shares)
        found.append((state.means, state.cov, state.alphas, torch.cat(shares)))
    for single, double in zip(*found, strict=True):
        largest = double.abs().reshape(len(double), -1).amax(1)
        apart = (single.double() - double).abs().reshape(len(double), -1).amax(
            1
        ) / largest.clamp_min(1e-3)
        assert (
            float(apart.quantile(0.98)) < 1e-3
        )  # areas of needles, of which float32 loses the width, are the others


@pytest.mark.parametrize("scene", [cloud(2000), extremes(2000, 1.0)], ids=["cloud", "extremes"])
def test_kernels_replace_pairs_as_torch_does(scene):
    state = state_of(scene)
    pairs = torch.randperm(2000, generator=torch.Generator().manual_seed(0))[:1800].view(2, -1)
    (one, ours), (other, theirs) = (
        replace_pairs(state, *pairs, MERGING, compiled) for compiled in (None, False)
    )
    assert torch.equal(ours.place, theirs.place) and torch.equal(one.counts, other.counts)
    # float64 inside, where the overlap of lines loses some digits; then float32
    torch.testing.assert_close(ours.shares, theirs.shares, rtol=1e-6, atol=1e-7)
    for name, values in vars(one).items():
        torch.testing.assert_close(values, getattr(other, name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("n", [2, 50, 5000])
def test_kernels_find_the_pairs_that_torch_finds(n):
    generator = torch.Generator().manual_seed(n)
    near = torch.randint(n, (n, 6), generator=generator, dtype=torch.int32)
    costs = torch.randint(9, (n, 6), generator=generator).float()  # many are equal
    costs[costs == 8] = math.inf
    ours, theirs = (cheapest_pairs(near, costs, compiled=compiled) for compiled in (None, False))
    assert len(ours[0]) > 0
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)


def by_definition(near: torch.Tensor, costs: torch.Tensor, passes: int) -> list[tuple[int, int]]:
    """The pairs of :func:`cheapest_pairs`, one at a time, where no two cost the same."""
    rows = near.tolist()
    prices = {}
    for i, row in enumerate(rows):
        for j, cost in zip(row, costs[i].tolist(), strict=True):
            if i in rows[j]:  # both are neighbours of each other
                cost = (cost + float(costs[j, rows[j].index(i)])) / 2 if i < j else math.inf
            if i != j and cost < prices.get((i, j), math.inf):
                prices[i, j] = cost
    found = []
    for _ in range(passes):
        taken = {member for pair in found for member in pair}
        free = [pair for pair in prices if not taken.intersection(pair)]
        best = {i: min((p for p in free if i in p), key=prices.get) for pair in free for i in pair}
        found += [pair for pair in free if best[pair[0]] == best[pair[1]] == pair]
    return sorted(found, key=prices.get)


@pytest.mark.parametrize("n", [1, 2, 9, 120])
def test_pairs_are_the_cheapest_of_both_members_pass_by_pass(n):
    """With neighbours that occur twice, or are none, and costs that are infinite or no numbers."""
    g = torch.Generator().manual_seed(n)
    near = torch.randint(0, n, (n, 6), generator=g, dtype=torch.int32)
    near[::3, 2] = near[::3, 4]
    near[::5, 1] = torch.arange(n, dtype=torch.int32)[::5]
    costs = torch.randperm(6 * n, generator=g).view(n, 6) / 1024  # sums of two are exact in float32
    costs[::7, 0] = math.inf
    costs[::11, 3] = math.nan
    for passes in (1, 6):
        first, second, prices = cheapest_pairs(near, costs, passes)
        assert list(zip(first.tolist(), second.tolist(), strict=True)) == by_definition(
            near, costs, passes
        )
        assert torch.equal(prices, prices.sort().values) and prices.dtype == torch.float32


@pytest.mark.parametrize("cost", [0.0, 3e38, math.inf, math.nan])
def test_there_is_a_pair_whatever_the_costs_and_known_costs_come_first(cost):
    """Else a round would merge nothing, and merging would never end."""
    near = torch.tensor([[1], [0], [3], [2]], dtype=torch.int32)
    costs = torch.full((4, 1), cost)
    first, second, prices = cheapest_pairs(near, costs)
    assert first.tolist() == [0, 2] or first.tolist() == [2, 0]
    assert bool(prices.isfinite().all()) and (first + 1).equal(second)
    costs[2:] = 1.0
    assert int(cheapest_pairs(near, costs)[0][0]) == (2 if cost else 0)


ALL = torch.arange(200)


def members_of(scene: Gaussians, blurs: torch.Tensor | None = None) -> Members:
    """All 200 Gaussians of a scene, with their blurs."""
    return Members(Participants(scene, ALL, torch.zeros(3, dtype=torch.float64), 1.0, blurs))


def moments_of(scene: Gaussians, group: torch.Tensor, count: int) -> Moments:
    """Moments of groups of all."""
    return group_moments(members_of(scene), group, count)


def after(scene: Gaussians, group: torch.Tensor, count: int) -> torch.Tensor:
    """The group that each fits best: the same by kernels and without them."""
    members = members_of(scene)
    groups = moments_of(scene, group, count)
    found, torchs = (
        best_groups(members, group, groups, compiled=compiled) for compiled in (None, False)
    )
    assert torch.equal(found, torchs)
    return found


def test_moments_are_those_of_the_members_and_between_them():
    scene = cloud(200)
    group = ALL % 7
    assert torch.equal(after(scene, group, 7).unique(), torch.arange(7)), "no group is left empty"
    groups = moments_of(scene, group, 7)
    masses = members_of(scene).masses
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
        torch.testing.assert_close(groups.shares(masses[these], group[these]), weights)
    torch.testing.assert_close(groups.mass.sum(), masses.sum())


def test_a_member_changes_its_group_by_position_and_by_colour():
    scene = cloud(200)
    means = scene.means.clone()
    colours = torch.zeros_like(scene.features_dc)
    side = ALL % 2
    means[:, 0] = 0.1 * means[:, 0] + 20.0 * side
    apart = scene.replace(means=means)
    group = side.clone()
    group[7] = 0
    assert torch.equal(after(apart, group, 2), side)
    colours[side == 1] = 3.0
    mixed = scene.replace(features_dc=colours)  # in one place, of two colours
    assert torch.equal(after(mixed, group, 2), side)
