"""The cost of a pair against an integral over pixels, and at the extremes of float32."""

from __future__ import annotations

import math

import pytest
import torch

from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.pruning import covariance as algebra
from pointsplat_ns.pruning import pair_costs
from pointsplat_ns.pruning.merge_state import GROWTH, MOST_SURPLUS, OPAQUE, State, start


def state_of(scene: Gaussians) -> State:
    """The state before the first round, of all Gaussians, in units of 1 around the origin."""
    n = len(scene)
    return start(scene, torch.arange(n), torch.ones(n), torch.zeros(3, dtype=torch.float64), 1.0)


def disks(seed: int = 1, logits: tuple[float, float] = (0.3, -0.6)) -> Gaussians:
    """Two overlapping disks in the plane z = 0, with opacities of these logits."""
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.tensor([[0.0, 0, 0], [0.08, 0.03, 0]]),
        scales=torch.tensor([[-3.0, -2.6, -9.0], [-2.7, -3.2, -9.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0.2], [1.0, 0, 0, -0.4]]),
        opacities=torch.tensor(logits)[:, None],
        features_dc=torch.randn(2, 3, generator=g),
        features_rest=torch.zeros(2, 0, 3),
    )


def seen_from(state: State, way: int, dtype: torch.dtype) -> pair_costs.Seen:
    seen = pair_costs.Seen.of(state, dtype)
    seen.look(state, torch.arange(len(state)), way)
    return seen


def seen_along_z(state: State) -> pair_costs.Seen:
    way = int(pair_costs.DIRECTIONS[:, 2].abs().argmax())
    assert float(pair_costs.DIRECTIONS[way, 2].abs()) == 1.0
    return seen_from(state, way, torch.float32)


@pytest.mark.parametrize(("logits", "grows"), [((0.3, -0.6), False), ((6.0, 6.0), True)])
def test_the_cost_is_the_integral_that_it_claims_to_be(logits, grows):
    """Against a sum over a fine grid in the plane, in float64."""
    scene = disks(logits=logits)
    state = state_of(scene)
    got = float(seen_along_z(state).costs(torch.tensor([0]), torch.tensor([[1]])))
    axis = torch.linspace(-0.6, 0.7, 1301, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1)
    cov = algebra.unpack(state.cov)[:, :2, :2]
    means, alphas = state.means[:, :2], state.alphas
    areas = torch.linalg.det(cov).sqrt()

    def splat(mean, cov):
        d = grid - mean
        return torch.exp(-0.5 * (d @ torch.linalg.inv(cov) * d).sum(-1))

    first, second = splat(means[0], cov[0]), splat(means[1], cov[1])
    pixel = 0.001**2 / (2 * math.pi)  # in the units of areas
    both = float((first * second).sum()) * pixel
    w = alphas * areas / (alphas * areas).sum()
    mean = (w[:, None] * means).sum(0)
    apart = means - mean
    merged_cov = (w[:, None, None] * (cov + apart[:, :, None] * apart[:, None])).sum(0)
    alpha = (alphas * areas).sum() - alphas[0] * alphas[1] * both
    alpha = alpha / torch.linalg.det(merged_cov).sqrt()
    assert (float(alpha) > OPAQUE) == grows
    merged_cov = merged_cov * (alpha / OPAQUE).clamp(1, MOST_SURPLUS) ** GROWTH
    alpha = alpha.clamp_max(OPAQUE)
    merged = splat(mean, merged_cov)
    on = alphas[1] * both / areas[0]
    cover = alphas[0] / 2 + on
    colours = scene.features_dc.double() * SH_C0
    around = (alphas[0] / 2 * colours[0] + on * colours[1]) / cover
    f = colours - around
    assumed = 3 * pair_costs.LOCAL_CONTRAST**2
    parts = torch.stack([alphas[0] * first, alphas[1] * second, -alpha * merged])
    change = torch.einsum("cij,cd->ijd", parts, torch.cat([f, (w[:, None] * f).sum(0)[None]]))
    shape = parts.sum(0).square().sum() * pixel
    blend = float(change.square().sum() * pixel + assumed * shape)
    through = 3 * pair_costs.BACKGROUND_CONTRAST**2 * math.exp(-4 * float(cover))
    want = blend / max(float(cover), 0.5) ** 2 + through * float(shape)
    assert got == pytest.approx(want, rel=2e-3)  # float32, where six terms nearly cancel


def test_members_of_different_colours_cost_more_than_of_equal_ones():
    scene = disks()
    colours = torch.tensor([[1.0, 1, 1], [-1.0, -1, -1]])
    i, j = torch.tensor([0]), torch.tensor([[1]])
    equal, different = (
        float(seen_along_z(state_of(scene.replace(features_dc=values))).costs(i, j))
        for values in (colours[[0, 0]], colours)
    )
    assert different > 10 * equal > 0


def test_shadows_of_all_directions_are_those_of_the_covariance():
    g = torch.Generator().manual_seed(3)
    six = algebra.covariances(torch.randn(5, 3, generator=g).double(), torch.randn(5, 4, generator=g).double())
    for axes, matrix in zip(pair_costs.AXES, pair_costs.TO_SHADOW, strict=True):
        want = algebra.flatten(six, axes[:, 0].expand(5, 3), axes[:, 1].expand(5, 3))
        torch.testing.assert_close(six @ matrix, want)


def test_every_direction_has_two_sides_across():
    across = (pair_costs.DIRECTIONS[pair_costs.SIDES] @ pair_costs.DIRECTIONS[pair_costs.SIDES].mT).abs()
    assert float((across - torch.eye(3, dtype=torch.float64)).abs().max()) < 0.6  # at least 53 degrees apart


def test_sizes_are_in_units_of_the_scene_and_bounded_where_they_are_wide_beyond_any_view():
    deviations = torch.tensor([0.5, 20.0, 500.0, 1e5])
    scene = Gaussians(
        means=torch.zeros(4, 3),
        scales=deviations.log()[:, None] + torch.tensor([0.0, -20, -20]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        opacities=torch.zeros(4, 1),
        features_dc=torch.zeros(4, 3),
        features_rest=torch.zeros(4, 0, 3),
    )
    state = start(scene, torch.arange(4), torch.ones(4), torch.zeros(3, dtype=torch.float64), 2.0)
    _, cov = pair_costs._scaled(state, torch.arange(len(state)))
    expected = torch.tensor([0.25, 10.0, 250.0, pair_costs.WIDEST], dtype=torch.float64)
    torch.testing.assert_close(cov[:, 0].sqrt(), expected, rtol=1e-6, atol=0.0)  # sizes are given in float32


def test_costs_are_finite_and_not_negative_at_the_extremes():
    """Positions, sizes and opacities over the whole range, each Gaussian with each other."""
    g = torch.Generator().manual_seed(0)
    n = 60
    scene = Gaussians(
        means=torch.randn(n, 3, generator=g) * 10 ** torch.empty(n, 1).uniform_(-8, 30, generator=g),
        scales=torch.empty(n, 3).uniform_(-90, 90, generator=g),
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.empty(n, 1).uniform_(-40, 40, generator=g),
        features_dc=torch.randn(n, 3, generator=g) * 10 ** torch.empty(n, 1).uniform_(-8, 30, generator=g),
        features_rest=torch.zeros(n, 0, 3),
    )
    others = torch.arange(n, dtype=torch.int32).expand(n, n)
    costs = pair_costs.costs_of(state_of(scene), others)
    assert bool(costs.isfinite().all()) and bool((costs >= 0).all())


def test_float32_costs_rank_pairs_as_float64_does():
    """Needles 1000 times as long as thick, which float32 cannot tell from lines without a floor on their width."""
    g = torch.Generator().manual_seed(1)
    n = 200
    scene = Gaussians(
        means=torch.rand(n, 3, generator=g),
        scales=torch.tensor([-2.0, -5.0, -9.0]) + 0.3 * torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.randn(n, 1, generator=g),
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.zeros(n, 0, 3),
    )
    state = state_of(scene)
    i, j = torch.arange(n), torch.randint(0, n, (n, 8), generator=g)
    single = pair_costs.costs_of(state, j.to(torch.int32)).double()
    for way in range(len(pair_costs.DIRECTIONS)):
        a, b = (seen_from(state, way, dtype).costs(i, j).double() for dtype in (torch.float64, torch.float32))
        assert float((a - b).abs().max()) < 1e-3 * float(a.max())
    assert bool(single.isfinite().all())
