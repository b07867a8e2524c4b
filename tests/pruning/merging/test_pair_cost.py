"""The cost of a pair against an integral over pixels; covariances; both at the extremes."""

import math
from dataclasses import replace

import pytest
import torch

from making import assert_same_on_any_threads, cloud, splats
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.pruning.merging import MERGING
from pointsplat_ns.pruning.merging import covariance as algebra
from pointsplat_ns.pruning.merging.covariance import (
    covariances,
    overlap,
    plane_axes,
    projected,
    projected_area,
    rms_area,
)
from pointsplat_ns.pruning.merging.pair_cost import DIRECTIONS, Flat, costs_in_plane, pair_costs
from pointsplat_ns.pruning.merging.state import Participants, State, initial_state
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.kernels import KERNELS

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def state_of(scene: Gaussians, size: float = 1.0) -> State:
    """The state before the first round, of all Gaussians, around the origin."""
    n = len(scene)
    participants = Participants(scene, torch.arange(n), torch.zeros(3, dtype=torch.float64), size)
    return initial_state(participants, torch.ones(n))


def disks(seed: int = 1, logits: tuple[float, float] = (0.3, -0.6)) -> Gaussians:
    """Two overlapping disks in the plane z = 0, with opacities of these logits."""
    g = torch.Generator().manual_seed(seed)
    means = torch.tensor([[0.0, 0, 0], [0.08, 0.03, 0]])
    scales = [[-3.0, -2.6, -9.0], [-2.7, -3.2, -9.0]]
    colours = torch.randn(2, 3, generator=g)
    quats = [[1.0, 0, 0, 0.2], [1.0, 0, 0, -0.4]]
    return splats(means, scales, torch.tensor(logits)[:, None], colours, quats)


@pytest.mark.parametrize(("logits", "grows"), [((0.3, -0.6), False), ((6.0, 6.0), True)])
def test_the_cost_is_the_integral_that_it_claims_to_be(logits, grows):
    """Against a sum over a fine grid in the plane, in float64."""
    scene = disks(logits=logits)
    state = state_of(scene)
    direction = int(DIRECTIONS[:, 2].abs().argmax())  # the z axis
    first = torch.tensor([0])
    second = torch.tensor([[1]])
    plane = torch.tensor([direction])
    got = float(costs_in_plane(state, first, second, plane, MERGING, torch.float32))
    axis = torch.linspace(-0.6, 0.7, 1301, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1)
    cov = algebra.unpack(state.cov.double())[:, :2, :2]
    means = state.means[:, :2].double()
    alphas = state.alphas.double()
    areas = torch.linalg.det(cov).sqrt()

    def splat(mean, cov):
        d = grid - mean
        return torch.exp(-0.5 * (d @ torch.linalg.inv(cov) * d).sum(-1))

    first = splat(means[0], cov[0])
    second = splat(means[1], cov[1])
    pixel = 0.001**2 / (2 * math.pi)  # in the units of areas
    both = float((first * second).sum()) * pixel
    w = alphas * areas / (alphas * areas).sum()
    mean = (w[:, None] * means).sum(0)
    apart = means - mean
    merged_cov = (w[:, None, None] * (cov + apart[:, :, None] * apart[:, None])).sum(0)
    alpha = (alphas * areas).sum() - alphas[0] * alphas[1] * both
    alpha = alpha / torch.linalg.det(merged_cov).sqrt()
    assert (float(alpha) > MERGING.max_opacity) == grows
    merged_cov = merged_cov * (alpha / MERGING.max_opacity).clamp(1, 4) ** MERGING.growth_exponent
    alpha = alpha.clamp_max(MERGING.max_opacity)
    merged = splat(mean, merged_cov)
    on = alphas[1] * both / areas[0]
    cover = alphas[0] / 2 + on
    colours = scene.features_dc.double() * SH_C0
    around = (alphas[0] / 2 * colours[0] + on * colours[1]) / cover
    f = colours - around
    assumed = 3 * 0.01**2
    parts = torch.stack([alphas[0] * first, alphas[1] * second, -alpha * merged])
    change = torch.einsum("cij,cd->ijd", parts, torch.cat([f, (w[:, None] * f).sum(0)[None]]))
    shape = parts.sum(0).square().sum() * pixel
    blend = float(change.square().sum() * pixel + assumed * shape)
    through = 3 * 0.3**2 * math.exp(-4 * float(cover))
    area_growth = float(torch.linalg.det(merged_cov).sqrt() / areas.sum())
    want = area_growth**2 * (blend / max(float(cover), 0.5) ** 2 + through * float(shape))
    assert got == pytest.approx(want, rel=2e-3)  # float32, where six terms nearly cancel


def extremes(n: int) -> Gaussians:
    """Positions, sizes and opacities over the whole range."""
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(n, 3, generator=g)
        * 10 ** torch.empty(n, 1).uniform_(-8, 30, generator=g),
        scales=torch.empty(n, 3).uniform_(-90, 90, generator=g),
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.empty(n, 1).uniform_(-40, 40, generator=g),
        features_dc=torch.randn(n, 3, generator=g)
        * 10 ** torch.empty(n, 1).uniform_(-8, 30, generator=g),
        features_rest=torch.zeros(n, 0, 3),
    )


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiler), False])
def test_costs_are_finite_and_not_negative_at_the_extremes(compiled):
    state = state_of(extremes(200))
    others = (torch.arange(200)[:, None] + torch.arange(8)) % 200
    costs = pair_costs(state, others.to(torch.int32), compiled=compiled)
    assert bool(costs.isfinite().all()) and bool((costs >= 0).all())


def crowded(n: int, generator: torch.Generator) -> Gaussians:
    """Gaussians of a splat's proportions, the second half beside those of the first. None has so
    little opacity that its cost nearly vanishes, which no float32 could tell from 0."""
    half = torch.rand(n // 2, 3, generator=generator)
    beside = half + 0.02 * torch.randn(n // 2, 3, generator=generator)
    flat = torch.tensor([-2.5, -3.0, -6.0])
    return Gaussians(
        means=torch.cat([half, beside]),
        scales=flat + 0.3 * torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        opacities=torch.empty(n, 1).uniform_(-1, 5, generator=generator),
        features_dc=torch.randn(n, 3, generator=generator),
        features_rest=torch.randn(n, 3, 3, generator=generator),
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_compiler), False])
@pytest.mark.parametrize(("k", "axes"), [(1, 1), (6, 8), (8, 3)])
def test_costs_in_float32_are_as_near_to_float64_as_their_terms_allow(k, axes, compiled, seed):
    """Both of kernels and of torch, within one bound. A cost is a sum of six terms that cancel to a
    hundredth, rarely to a thousandth. Of 40 seeds the largest relative errors, in units of
    float32's rounding, were 7.2 (median), 234 (99 %) and 3037 (all): less than half the bounds."""
    g = torch.Generator().manual_seed(seed)
    n = 500
    scene = crowded(n, g)
    participants = Participants(
        scene, torch.arange(n), torch.full((3,), 0.5, dtype=torch.float64), 1.7
    )
    state = initial_state(participants, torch.rand(n, generator=g))
    state = replace(state, colours=state.colours[:, -axes:].contiguous())
    near = torch.randint(0, n, (n, k), generator=g, dtype=torch.int32)
    near[:, 0] = (torch.arange(n) + n // 2) % n  # the one beside it: replacements grow
    others = near != torch.arange(n)[:, None]
    exact = pair_costs(state, near, dtype=torch.float64)[others]
    found = pair_costs(state, near, compiled=compiled)[others].double()
    errors = (found - exact).abs() / exact / 2**-24
    for share, bound in ((0.5, 15), (0.99, 500), (1.0, 8000)):
        assert float(errors.quantile(share)) < bound


def test_float32_costs_rank_pairs_as_float64_does():
    """Needles 1000 times as long as thick, which float32 cannot tell from lines without a floor on
    their width."""
    scene = cloud(200, seed=1, sh_degree=0)
    scene = scene.replace(scales=torch.tensor([-2.0, -5.0, -9.0]) + 0.6 * (scene.scales + 3))
    near = torch.randint(0, 200, (200, 8), generator=torch.Generator().manual_seed(1))
    state = state_of(scene)
    a, b = (
        pair_costs(state, near, dtype=dtype, compiled=False)
        for dtype in (torch.float64, torch.float32)
    )
    assert float((a - b).abs().max()) < 2e-3 * float(a.max())  # 1e-3 of an area, squared


def test_the_area_is_the_root_mean_square_over_directions():
    g = torch.Generator().manual_seed(3)
    six = covariances(
        torch.randn(1, 3, generator=g).double(), torch.randn(1, 4, generator=g).double()
    )
    ways = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=g).double(), dim=1)
    areas = projected_area(projected(six.expand(len(ways), 6), *plane_axes(ways)))
    assert float(rms_area(six)) == pytest.approx(
        float(areas.square().mean().sqrt()), rel=0.01
    )  # 200,000 samples


@pytest.mark.parametrize("length", [1.0, 1e6, 1e30])
@pytest.mark.parametrize("width", [1.0, 1e-9, 0.0])
def test_no_overlap_exceeds_the_smaller_area(length, width):
    """Of needles along one direction, whose areas are lost to rounding as soon as they are long
    enough."""
    generator = torch.Generator().manual_seed(0)
    angle = torch.rand(200, generator=generator, dtype=torch.float64) * 7
    along = torch.stack([angle.cos(), angle.sin()])
    across = torch.stack([-angle.sin(), angle.cos()])
    flat = torch.stack(
        [
            length**2 * along[i] * along[j] + width**2 * across[i] * across[j]
            for i, j in ((0, 0), (0, 1), (1, 1))
        ],
        1,
    )
    u, v = along * length * torch.rand(200, generator=generator, dtype=torch.float64)
    found = overlap(flat, 0.5 * flat, u, v)
    assert found.isfinite().all() and (found >= 0).all()
    # 1e-6: the areas themselves are rounded
    assert (
        found <= (1 + 1e-6) * torch.minimum(projected_area(flat), projected_area(0.5 * flat))
    ).all()


@pytest.mark.parametrize(
    ("first", "second", "apart"),
    [
        ((4.0, 0.0, 4.0), (4.0, 0.0, 4.0), (3.0, 1.0)),
        ((3.0, 1.2, 2.0), (1.0, -0.5, 2.5), (0.9, -1.4)),
    ],
)
def test_the_overlap_is_the_fast_form_of_it_away_from_lines(first, second, apart):
    """The fast form is, as costs are."""
    first, second, (u, v) = (
        torch.tensor(values, dtype=torch.float64)[:, None] for values in (first, second, apart)
    )
    assert overlap(first.T, second.T, u, v).item() == pytest.approx(
        Flat(*first).overlap(Flat(*second), u, v).item()
    )


@needs_compiler
def test_covariances_by_the_kernel_are_those_of_torch_also_at_the_extremes():
    g = torch.Generator().manual_seed(5)
    scene = cloud(5000)
    scales = scene.scales.clone()
    quats = scene.quats.clone()
    scales[:500] = 60 * torch.randn(500, 3, generator=g)
    scales[500:600, 2] = -math.inf
    scales[600:610] = -math.inf
    quats[:400] *= 1e-20
    quats[400:700] = 0.0
    quats[700:800] *= 1e18
    scene = scene.replace(scales=scales, quats=quats)
    rows = torch.randperm(5000, generator=g)[:4500]
    found, torchs = (algebra.covariances_of(scene, rows, compiled) for compiled in (True, False))
    assert bool(found.isfinite().all())
    assert (
        float(((found - torchs).abs() / torchs.abs().amax(1, keepdim=True)).max()) < 1e-13
    )  # float64
    assert_same_on_any_threads(lambda: [algebra.covariances_of(scene, rows)])
