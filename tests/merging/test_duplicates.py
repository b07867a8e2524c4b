"""Exact copies, and SH bands."""

import math

import pytest
import torch

from making import cloud, normal_scene, same
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.merging import duplicates, merge, rounds
from pointsplat_ns.merging.duplicates import Copies, stacked
from pointsplat_ns.pruning import band_energies, cut_sh, energy_lost
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis


def with_zeros(n: int = 700, zeros: int = 300) -> tuple[Gaussians, torch.Tensor]:
    """A cloud in which rows of nothing but zeros are strewn, as in broken files, and the mask of these."""
    rows = Gaussians(*(torch.zeros(zeros, *value.shape[1:]) for value in cloud(1).tensors()))
    order = torch.randperm(n + zeros, generator=torch.Generator().manual_seed(1))
    return Gaussians.cat([cloud(n), rows])[order], order >= n


def covered(alpha: float, count: int, growth: float = 0.0) -> float:
    """Integral of what ``count`` equal Gaussians of unit size cover, as the rasterizer draws them, by 300,000 rings."""
    r = torch.linspace(0, 20, 300_001, dtype=torch.float64)
    drawn = alpha * torch.exp(-0.5 * (r / math.exp(growth)).square())
    drawn = torch.where(drawn < ALPHA_MIN, 0, drawn.clamp_max(ALPHA_MAX))
    return float(((1 - (1 - drawn) ** count) * r).sum() * (r[1] - r[0]))


@pytest.mark.parametrize("count", [1, 2, 3, 100, 10**6])
def test_one_covers_as_much_as_all_copies_and_is_as_opaque_at_the_centre(count):
    alphas = torch.tensor([0.00393, 0.02, 0.1, 0.5, 0.99, 1.0], dtype=torch.float64)
    found, growth = stacked(alphas, torch.full((6,), count))
    # one by one, naively, so not to rel 1e-15
    torch.testing.assert_close(found, (1 - (1 - alphas) ** count).clamp_max(ALPHA_MAX), rtol=1e-9, atol=0)
    for alpha, one, grown in zip(alphas.tolist(), found.tolist(), growth.tolist(), strict=True):
        # The rings are as coarse as 3e-3 of the small disk that is drawn of the faintest.
        want = covered(alpha, count)
        assert covered(one, 1, grown) == pytest.approx(want, rel=5e-3 if alpha < 0.01 else 1e-3), alpha


def test_copies_too_faint_to_be_drawn_stay_too_faint():
    faint = torch.tensor([0.0, 1e-300, 1e-5, ALPHA_MIN], dtype=torch.float64)
    alphas, growth = stacked(faint, torch.tensor([1000] * 4))
    assert torch.equal(alphas, faint) and growth.tolist() == [0.0] * 4


def test_those_alike_in_all_but_one_parameter_are_no_copies():
    one = cloud(1, sh_degree=3)
    other = [one]
    for name, value in one.items():
        for column in range(value[0].numel()):
            changed = value.clone()
            changed.view(-1)[column] = torch.nextafter(changed.view(-1)[column], torch.tensor(math.inf))
            other.append(one.replace(**{name: changed}))
    scene = Gaussians.cat([*other, *other])
    n = len(other)
    copies = Copies(scene, torch.arange(2 * n))
    assert n == 60 and copies.distinct == n
    assert copies.first.tolist() == [*range(n), *range(n)]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_copies_are_found_in_any_precision_and_pieces(dtype, monkeypatch):
    scene, zero = with_zeros()
    members = torch.arange(1, len(scene), 2)
    monkeypatch.setattr(duplicates, "CHUNK", 37)
    copies = Copies(scene.to(dtype), members)
    zero = zero[members]
    assert copies.distinct == int((~zero).sum()) + 1
    assert torch.equal(copies.first[~zero], torch.arange(len(members))[~zero])
    assert bool((copies.first[zero] == zero.nonzero()[0]).all())


def test_hashes_that_collide_make_no_copies_of_others(monkeypatch):
    monkeypatch.setattr(duplicates, "_hashes", lambda columns, rows: torch.zeros(len(rows), dtype=torch.int64))
    scene = cloud(50)
    assert Copies(scene, torch.arange(50)).distinct == 50
    assert Copies(Gaussians.cat([scene, scene[:1]]), torch.arange(51)).first.tolist() == [*range(50), 0]


@pytest.mark.parametrize("k", [701, 702, 850, 999])
def test_the_count_is_exact_also_where_fewer_differ(k):
    scene, zero = with_zeros()
    merged = merge(scene, k)
    assert len(merged.scene) == k and bool(merged.scene.usable().all())
    assert merged.assignment.bincount(minlength=k).min() == 1
    assert same(merged.scene[merged.assignment[~zero]], scene[~zero])  # they are kept to the bit
    firsts = merged.assignment[zero].unique()
    assert len(firsts) == k - 700 and same(merged.scene[firsts[1:]], scene[zero][1 : len(firsts)])


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


@pytest.mark.parametrize("case", ["empty", "no colour", "invisible", "nan", "huge scales", "larger scales", "degree 0"])
def test_where_there_is_nothing_to_lose_nothing_is_lost(case):
    scene = normal_scene(20)
    scene = {
        "empty": lambda: Gaussians.empty(3),
        "no colour": lambda: scene.replace(features_rest=torch.zeros_like(scene.features_rest)),
        "invisible": lambda: scene.replace(opacities=torch.full_like(scene.opacities, -math.inf)),
        "nan": lambda: scene.map(lambda value: value * math.nan),
        "huge scales": lambda: scene.replace(scales=torch.full_like(scene.scales, 88.0)),
        "larger scales": lambda: scene.replace(scales=torch.full_like(scene.scales, 1e4)),  # are not drawn
        "degree 0": lambda: normal_scene(20, 0),
    }[case]()
    lost = energy_lost(scene, 0)
    assert lost == pytest.approx(1.0) if case == "huge scales" else lost == 0.0


@pytest.mark.parametrize("degree", [-1, 4])
def test_a_degree_that_is_none_is_said(degree):
    for function in (cut_sh, energy_lost):
        with pytest.raises(BudgetError, match=f"SH degree is {degree}; expected 0 to 3"):
            function(normal_scene(20), degree)


def test_where_only_copies_go_nothing_is_drawn_or_compared(monkeypatch):
    """A million copies cost renders in which each covers the picture, though no pair is chosen."""
    scene = normal_scene(1, degree=1)[[0] * 5000]
    for name in ("views_and_weights", "other_neighbours", "pair_costs"):
        monkeypatch.setattr(rounds, name, lambda *given: pytest.fail("no pair is to be chosen"))
    merged = rounds.merge(scene, 1500)
    assert len(merged.scene) == 1500 and merged.finish.psnr is None
    assert len(merged.assignment.unique()) == 1500 and int(merged.assignment.min()) == 0
    with pytest.raises(pytest.fail.Exception):
        rounds.merge(scene.replace(means=scene.means + torch.arange(5000)[:, None]), 1500)
