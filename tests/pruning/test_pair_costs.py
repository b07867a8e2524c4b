"""The cost of a pair against an integral over pixels, and at the extremes of float32."""

from __future__ import annotations

import math

import pytest
import torch

from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.geometry.quaternions import rotation_matrices
from pointsplat_ns.pruning import covariance as algebra
from pointsplat_ns.pruning import pair_costs
from pointsplat_ns.pruning.merge_state import OPAQUE, State, start


def state_of(scene: Gaussians) -> State:
    """The state before the first round, of all Gaussians, in units of 1 around the origin."""
    n = len(scene)
    return start(scene, torch.arange(n), torch.ones(n), torch.zeros(3, dtype=torch.float64), 1.0)


def disks(seed: int = 1) -> Gaussians:
    """Two overlapping disks in the plane z = 0."""
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.tensor([[0.0, 0, 0], [0.08, 0.03, 0]]),
        scales=torch.tensor([[-3.0, -2.6, -9.0], [-2.7, -3.2, -9.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0.2], [1.0, 0, 0, -0.4]]),
        opacities=torch.tensor([[0.3], [-0.6]]),
        features_dc=torch.randn(2, 3, generator=g),
        features_rest=torch.zeros(2, 0, 3),
    )


def change_in_plane(state: State, i: torch.Tensor, j: torch.Tensor, axes: torch.Tensor, u: int, v: int, dtype=None):
    """Costs (m, k) of merging Gaussians ``i`` (m,) with neighbours ``j`` (m, k), seen in the plane of two of their
    ``axes`` (m, 3, 3), in float32 or ``dtype``."""
    dtype = dtype or torch.float32
    (m, k), flat = j.shape, j.flatten()
    turned = axes.mT[:, None] @ algebra.unpack(state.cov[flat]).view(m, k, 3, 3) @ axes[:, None]
    own = axes.mT @ algebra.unpack(state.cov[i]) @ axes
    shadows = [
        pair_costs._shadow(algebra.pack(matrix).view(m, -1, 6).to(dtype), u, v)
        for matrix in (own, turned.flatten(0, 1))
    ]
    apart = ((state.means[i][:, None] - state.means[flat].view(m, k, 3)) @ axes).to(dtype)
    colours = state.colours.to(dtype)
    paints = [
        pair_costs.Paint(state.alphas[these].to(dtype), colours[these], colours[these].square().sum(-1))
        for these in (i[:, None], j)
    ]
    return pair_costs.change(*shadows, *paints, apart[..., u], apart[..., v])


def change_seen_along_z(state: State) -> float:
    """Cost of merging the first of two with the second."""
    axes = torch.eye(3, dtype=torch.float64)[None]
    return float(change_in_plane(state, torch.tensor([0]), torch.tensor([[1]]), axes, 0, 1))


def test_the_cost_is_the_integral_that_it_claims_to_be():
    """Against a sum over a fine grid in the plane, in float64."""
    scene = disks()
    state = state_of(scene)
    got = change_seen_along_z(state)
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
    assert float(alpha) < OPAQUE  # no growth
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
    equal, different = (
        change_seen_along_z(state_of(scene.replace(features_dc=values))) for values in (colours[[0, 0]], colours)
    )
    assert different > 10 * equal > 0


def test_covariances_are_turned_to_the_axes_of_another():
    g = torch.Generator().manual_seed(3)
    six = algebra.covariances(torch.randn(5, 3, generator=g).double(), torch.randn(5, 4, generator=g).double())
    axes = rotation_matrices(torch.randn(5, 4, generator=g).double())
    got = (six[:, None] @ pair_costs._turn(axes))[:, 0]
    torch.testing.assert_close(got, algebra.pack(axes.mT @ algebra.unpack(six) @ axes))


def test_axes_are_the_thinnest_the_longest_and_the_one_across():
    g = torch.Generator().manual_seed(4)
    logs = torch.tensor([[-1.0, -2.0, -6.0], [-3.0, -1.0, -1.2], [0.0, -9.0, -8.0]]).repeat(50, 1).double()
    cov = algebra.covariances(logs, torch.randn(150, 4, generator=g).double())
    axes = pair_costs.own_axes(cov)
    torch.testing.assert_close(axes.mT @ axes, torch.eye(3).double().expand(150, 3, 3))
    along = (axes.mT @ algebra.unpack(cov) @ axes).diagonal(dim1=1, dim2=2)
    wanted = (2 * logs.sort(dim=1).values).exp()[:, [0, 2, 1]]
    torch.testing.assert_close(along, wanted, rtol=1e-6, atol=0)


@pytest.mark.parametrize("quat", [[1.0, 0, 0, 1], [1.0, 1, 0, 0], [0.3, -0.5, 0.8, 0.1]])
def test_costs_do_not_depend_on_the_axes_of_the_world(quat):
    g = torch.Generator().manual_seed(5)
    n = 300
    scene = Gaussians(
        means=torch.rand(n, 3, generator=g),
        scales=torch.tensor([-2.0, -2.6, -5.0]) + 0.1 * torch.randn(n, 3, generator=g),
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.randn(n, 1, generator=g),
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.zeros(n, 0, 3),
    ).to(torch.float64)
    near = torch.randint(0, n, (n, 8), generator=g, dtype=torch.int32)
    w, x, y, z = quat = torch.nn.functional.normalize(torch.tensor(quat, dtype=torch.float64), dim=0)
    left = torch.stack([quat, torch.stack([-x, w, z, -y]), torch.stack([-y, -z, w, x]), torch.stack([-z, y, -x, w])])
    turned = scene.replace(means=scene.means @ rotation_matrices(quat[None])[0].T, quats=scene.quats @ left)
    before, after = (pair_costs.costs_of(state_of(some), near) for some in (scene, turned))
    # float32, in which six terms nearly cancel; by fixed directions, half of the costs differed by a fifth
    torch.testing.assert_close(after, before, rtol=1e-2, atol=1e-4 * float(before.max()))


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
    axes = pair_costs.own_axes(state.cov)
    for plane in pair_costs.PLANES:
        a, b = (change_in_plane(state, i, j, axes, *plane, dtype).double() for dtype in (torch.float64, torch.float32))
        assert float((a - b).abs().max()) < 1e-3 * float(a.max())
    assert bool(single.isfinite().all())
