"""Merging of Gaussians: exact counts, what is preserved, and what must survive at the extremes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from statistics import fmean

import pytest
import torch

import pointsplat_ns as ps
from making import cloud, same
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.quaternions import rotation_matrices
from pointsplat_ns.metrics import finite_psnr
from pointsplat_ns.pruning import covariance as algebra
from pointsplat_ns.pruning import merge as merging
from pointsplat_ns.pruning.finishing import Finish
from pointsplat_ns.pruning.merge import merge, merge_levels
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.constants import ALPHA_MAX
from pointsplat_ns.refiner.augmentation import Transform
from pointsplat_ns.views import Views


def wall(side: int = 40, seed: int = 0) -> Gaussians:
    """A flat wall of round disks, of a smooth colour gradient, that covers itself several times."""
    g = torch.Generator().manual_seed(seed)
    axis = torch.linspace(-1, 1, side)
    x, y = (v.reshape(-1) for v in torch.meshgrid(axis, axis, indexing="xy"))
    n = side * side
    means = torch.stack([x, y, torch.zeros(n)], 1) + 0.004 * torch.randn(n, 3, generator=g)
    colours = torch.stack([x, y, -x], 1)
    scales = torch.tensor([math.log(2 / side), math.log(2 / side), -7.0]).repeat(n, 1)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(means, scales, quats, torch.full((n, 1), 1.5), colours, torch.zeros(n, 0, 3))


def render(scene: Gaussians, size: int = 64) -> torch.Tensor:
    view = torch.eye(4)
    view[2, 3] = 2.0
    K = torch.tensor([[size * 1.2, 0, size / 2], [0, size * 1.2, size / 2], [0, 0, 1.0]])
    args = (scene.means, scene.quats, scene.stds, scene.alphas, scene.sh, view[None], K[None], size, size)
    return rasterization(*args, sh_degree=scene.sh_degree)[0][0]


def sizes_of(merged: merging.Merged) -> torch.Tensor:
    """How many Gaussians each of the merged stands for, (K,)."""
    return torch.bincount(merged.assignment[merged.assignment >= 0], minlength=len(merged.scene))


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * torch.log10((a - b).square().mean()))


@pytest.mark.parametrize("k", [1, 2, 7, 100, 299, 300])
def test_gives_exactly_k_that_can_be_drawn(k):
    merged = merge(cloud(300), k)
    assert len(merged.scene) == k
    assert bool(merged.scene.usable().all())
    assert int(sizes_of(merged).sum()) == int((merged.assignment >= 0).sum())
    assert bool((sizes_of(merged) >= 1).all())


def test_keeping_all_returns_the_scene_bit_for_bit_even_with_nan():
    scene = cloud(20)
    scene.means[3] = math.nan
    kept = merge(scene, 20).scene
    assert all(
        torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0)) for a, b in zip(scene.tensors(), kept.tensors(), strict=True)
    )


def test_what_is_merged_with_nothing_is_bit_for_bit_as_it_was():
    scene = cloud(200)
    merged = merge(scene, 150)
    alone = (sizes_of(merged) == 1).nonzero()[:, 0]
    assert len(alone) > 50
    where = torch.stack([(merged.assignment == a).nonzero()[0, 0] for a in alone])
    assert same(merged.scene[alone], scene[where])


def test_the_same_input_gives_the_same_output():
    assert same(merge(cloud(500), 60).scene, merge(cloud(500), 60).scene)


def test_a_smooth_wall_at_a_quarter_looks_the_same_and_far_better_than_a_quarter_of_it():
    scene = wall()
    dense = render(scene)
    k = len(scene) // 4
    merged = psnr(render(merge(scene, k).scene), dense)
    thinned = psnr(render(scene[torch.arange(0, len(scene), 4)]), dense)
    assert merged > 30  # a difference of 3 % of the range is hardly seen
    assert merged > thinned + 6


def test_an_edge_between_colours_stays_where_it_is():
    scene = wall()
    left = scene.means[:, 0] < 0
    black_white = torch.where(left[:, None], -1.7, 1.7).expand(-1, 3).clone()
    scene = scene.replace(features_dc=black_white)
    merged = merge(scene, len(scene) // 4)
    # None of the merged has members of both colours: same-coloured neighbours were always cheaper.
    for side in (left, ~left):
        assert not set(merged.assignment[side].tolist()) & set(merged.assignment[~side].tolist())


def test_two_coincident_halves_become_one_of_their_common_mass():
    one = cloud(1)
    # Exact copies would never be merged as a pair.
    pair = Gaussians.cat([one, one.replace(means=one.means + 1e-6)]).replace(opacities=torch.zeros(2, 1))
    result = merge(pair, 1)
    merged, finish = result.scene, result.finish
    # Mass 0.5 + 0.5 less the integral of what is covered twice, 0.25 G^2: half of 0.25; then deepened for two members.
    want = 1 - 0.125 ** (2**finish.deepening)
    assert float(merged.alphas) == pytest.approx(want, rel=1e-5)  # float32, 7 digits
    torch.testing.assert_close(merged.means, one.means)
    want_scales = one.scales.sort().values + finish.spread
    torch.testing.assert_close(merged.scales.sort().values, want_scales, rtol=1e-4, atol=1e-4)


def test_deepening_leaves_one_member_as_it_is_and_grows_with_their_number_up_to_opaque():
    alphas = torch.tensor([0.0, 1e-12, 0.3, 0.3, 0.3, 0.9, 1.0], dtype=torch.float64)
    sizes = torch.tensor([10**6, 16, 1, 2, 16, 10**6, 10**6])
    most = ALPHA_MAX
    want = torch.tensor([0, 2e-12, 0.3, 1 - 0.7 ** (2**0.25), 1 - 0.7**2, most, most], dtype=torch.float64)
    # rel: 1 - (1 - a)^p to all digits even where a is far below float64's spacing at 1
    torch.testing.assert_close(merging.deepened(alphas, sizes, 0.25), want, rtol=1e-11, atol=0)
    assert float((merging.deepened(alphas.float(), sizes, 0.25) - want).abs().max()) < 1e-6  # float32, 7 digits


def test_colour_of_a_pair_is_the_mean_by_mass():
    pair = cloud(2)
    pair = pair.replace(scales=torch.full((2, 3), -2.0), opacities=torch.logit(torch.tensor([[0.6], [0.2]])))
    merged = merge(pair, 1).scene
    torch.testing.assert_close(merged.sh, 0.75 * pair[0].sh + 0.25 * pair[1].sh)


def test_first_and_second_moments_of_a_pair_are_those_of_its_mass():
    pair = cloud(2, seed=4).replace(opacities=torch.full((2, 1), -3.0))  # faint: no growth
    result = merge(pair, 1)
    merged, finish = result.scene.to(torch.float64), result.finish
    pair = pair.to(torch.float64)
    cov = algebra.unpack(algebra.covariances(pair.scales, pair.quats))
    mass = algebra.shadow(algebra.pack(cov))
    w = (mass / mass.sum())[:, None]
    mean = (w * pair.means).sum(0)
    grown = math.exp(2 * finish.spread)
    apart = pair.means - mean
    want = grown * (w[..., None] * (cov + apart[:, :, None] * apart[:, None])).sum(0)
    torch.testing.assert_close(merged.means[0], mean, rtol=1e-5, atol=1e-6)  # stored as float32
    torch.testing.assert_close(
        algebra.unpack(algebra.covariances(merged.scales, merged.quats))[0], want, rtol=1e-4, atol=1e-7
    )


def test_the_shadow_is_the_root_mean_square_over_directions():
    g = torch.Generator().manual_seed(3)
    six = algebra.covariances(torch.randn(1, 3, generator=g).double(), torch.randn(1, 4, generator=g).double())
    ways = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=g).double(), dim=1)
    areas = algebra.flat_area(algebra.flatten(six.expand(len(ways), 6), *algebra.plane(ways)))
    assert float(algebra.shadow(six)) == pytest.approx(float(areas.square().mean().sqrt()), rel=0.01)  # 200,000 samples


def test_normals_are_the_thinnest_axes():
    g = torch.Generator().manual_seed(5)
    logs = torch.tensor([-1.0, -2.0, -6.0]).repeat(50, 1)
    quats = torch.randn(50, 4, generator=g).double()
    along = algebra.normals(algebra.covariances(logs.double(), quats))
    cosine = (along * rotation_matrices(quats)[:, :, 2]).sum(1).abs()
    assert float(cosine.min()) > 0.9999


def extreme_scenes():
    base = cloud(60)
    grow = base.scales.clone()
    grow[7] = 80.0
    spread = base.scales.clone()
    spread[::2], spread[1::2] = 80.0, -80.0
    flat = base.scales.clone()
    flat[:, 2] = -math.inf
    points = torch.full_like(base.scales, -math.inf)
    far = base.means.clone()
    far[0] = 1e7
    logits = base.opacities.clone()
    logits[::2], logits[1::2] = math.inf, -math.inf
    return {
        "log-scales of +-80": base.replace(scales=spread),
        "a single giant": base.replace(scales=grow),
        "a zero axis": base.replace(scales=flat),
        "zero scales": base.replace(scales=points),
        "all coincident": base.replace(means=base.means[:1].expand(60, 3).clone()),
        "all the same": base[torch.zeros(60, dtype=torch.long)],
        "a far outlier": base.replace(means=far),
        "all far away": base.replace(means=base.means + 1e6),
        "infinite logits": base.replace(opacities=logits),
        "all opaque": base.replace(opacities=torch.full((60, 1), math.inf)),
        "all invisible": base.replace(opacities=torch.full((60, 1), -math.inf)),
        "zero quaternions": base.replace(quats=torch.zeros(60, 4)),
        "huge colours": base.replace(features_dc=base.features_dc * 1e15),
        "float64": base.to(torch.float64),
        "half precision": base.to(torch.float16),
    }


@pytest.mark.parametrize("k", [1, 20, 59])
@pytest.mark.parametrize("name", list(extreme_scenes()))
def test_extremes_give_k_drawable_gaussians(name, k):
    scene = extreme_scenes()[name]
    merged = merge(scene, k).scene
    assert len(merged) == k and merged.dtype == scene.dtype
    assert bool(merged.usable().all())


def test_many_coincident_gaussians_are_merged_in_few_rounds():
    reports = []
    scene = cloud(4000)
    scene = scene.replace(means=torch.zeros(4000, 3))
    assert len(merge(scene, 40, progress=reports.append).scene) == 40
    assert len(reports) < 40
    assert reports == sorted(reports) and reports[-1] == 1.0


def test_nan_and_meaningless_infinities_are_never_part_of_the_result():
    scene = cloud(50)
    scene.means[3, 1] = math.nan
    scene.scales[4] = math.inf
    scene.features_dc[5] = math.nan
    merged = merge(scene, 30)
    assert merged.assignment[[3, 4, 5]].tolist() == [-1, -1, -1]
    assert bool(merged.scene.usable().all())


def test_the_invisible_go_first_and_the_least_opaque_of_them_before():
    scene = cloud(50)
    scene.opacities[:20, 0] = -torch.arange(10.0, 30.0)
    merged = merge(scene, 30)
    assert bool((merged.assignment[:20] == -1).all()) and same(merged.scene, scene[20:])
    assert same(merge(scene, 33).scene, Gaussians.cat([scene[:3], scene[20:]]))


@pytest.mark.parametrize("k", [0, -1, 51])
def test_an_impossible_count_is_an_error(k):
    with pytest.raises(BudgetError, match="expected 1 to 50"):
        merge(cloud(50), k)


def test_more_than_can_be_drawn_is_an_error():
    scene = cloud(50)
    scene.means[:10] = math.nan
    with pytest.raises(BudgetError, match="40 of 50"):
        merge(scene, 45)


def test_float32_and_float64_make_the_same_scene():
    """All sums are in float64, so only the last rounding differs."""
    single, double = cloud(300), cloud(300).to(torch.float64)
    # alphas are computed in the scene's own precision, whence the tolerance
    a, b = render(merge(single, 60).scene), render(merge(double, 60).scene.to(torch.float32))
    assert psnr(a, b) > 50


def test_levels_are_nested_and_exact_and_a_level_alone_is_that_of_merging():
    scene = cloud(400)
    levels = list(merge_levels(scene, [400, 200, 50, 3]))
    assert [len(level.scene) for level in levels] == [400, 200, 50, 3]
    assert same(levels[0].scene, scene)
    assert same(next(merge_levels(scene, [200])).scene, merge(scene, 200).scene)
    for finer, coarser in itertools.pairwise(levels):
        parents = torch.full((len(finer.scene),), -1)
        parents[finer.assignment] = coarser.assignment
        assert torch.equal(parents[finer.assignment], coarser.assignment)


@pytest.mark.parametrize("counts", [[60], [60, 20], [20], [20, 7]])
def test_the_share_done_rises_and_ends_at_1_with_the_last_level(counts):
    shares = []
    reached = [shares[-1] for _ in merge_levels(cloud(60), counts, progress=shares.append)]
    assert shares == sorted(shares) and all(0 <= share <= 1 for share in shares)
    assert reached[-1] == 1 and all(share < 1 for share in reached[:-1])


@pytest.mark.parametrize("counts", [[10, 10], [10, 20], [5, 0], [51]])
def test_levels_that_do_not_descend_are_an_error(counts):
    with pytest.raises(BudgetError, match="expected"):
        merge_levels(cloud(50), counts)


def test_the_size_of_the_units_and_the_place_of_the_origin_do_not_matter(monkeypatch):
    monkeypatch.setattr(merging, "FEWEST_SEEN", 0)
    scene = cloud(300)
    want = merge(scene, 60)
    for factor, shift in ((1e-3, 0.0), (1024.0, 0.0), (1.0, 64.0)):
        moved = scene.replace(means=scene.means * factor + shift, scales=scene.scales + math.log(factor))
        got = merge(moved, 60)
        # float32 positions 64 units away have 4e-6 left, so a few ties may fall otherwise
        assert float((got.assignment == want.assignment).float().mean()) > 0.9, (factor, shift)
        assert got.finish.deepening == pytest.approx(want.finish.deepening, abs=0.05)


def test_small_things_where_people_look_are_kept_before_large_ones_far_away():
    """Two walls alike but for their size: as many Gaussians, the same pattern, one ten times as large and as far."""
    near = wall(20)
    colours = torch.where((torch.arange(400) // 20 + torch.arange(400)) % 2 == 0, 1.5, -1.5)[:, None].expand(-1, 3)
    near = near.replace(features_dc=colours.clone(), means=near.means + torch.tensor([0.0, 0.0, 2.0]))
    far = near.replace(means=near.means * 10 * torch.tensor([1.0, 1.0, -1.0]), scales=near.scales + math.log(10))
    both = Gaussians.cat([near, far])
    merged = merge(both, 400, views=one_view())
    of_near = (merged.assignment[:400].unique().numel(), merged.assignment[400:].unique().numel())
    assert of_near[0] >= 0.4 * 400 and sum(of_near) == 400
    from_afar = merge(both, 400, views=one_view(20.0))  # beside the large one
    assert from_afar.assignment[400:].unique().numel() > of_near[1]


def test_what_the_given_views_do_not_show_is_merged_first():
    """Two equal walls, one before the camera and one behind it."""
    ahead = wall(20).replace(features_dc=torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    ahead = ahead.replace(means=ahead.means + torch.tensor([0.0, 0.0, 2.0]))
    both = Gaussians.cat([ahead, ahead.replace(means=ahead.means * torch.tensor([1.0, 1.0, -1.0]))])
    shown, hidden = (
        merge(both, 400, views=one_view()).assignment[part].unique().numel() for part in (slice(400), slice(400, 800))
    )
    assert shown > 1.8 * hidden
    eyes_only = merge(both, 400).assignment
    assert eyes_only[:400].unique().numel() < 1.5 * eyes_only[400:].unique().numel()


def one_view(back: float = 0.0) -> Views:
    """A view from the origin, or from behind it."""
    viewmats = torch.eye(4)[None].clone()
    viewmats[0, 2, 3] = back
    K = torch.tensor([[32.0, 0, 32], [0, 32.0, 32], [0, 0, 1.0]])
    return Views(viewmats, K[None], 64, 64, torch.zeros(3))


def test_one_pair_is_enough_for_a_finish_to_be_chosen():
    scene = cloud(60).replace(means=cloud(60).means + torch.tensor([0.0, 0.0, 4.0]))
    assert merge(scene, 59, views=one_view()).finish.psnr is not None


@dataclass
class Half:
    """Shown are a fifth of all neighbourhoods, and half of each."""

    count: int

    @classmethod
    def of(cls, scene, members, weights, views):
        """Whatever the views show."""
        assert len(members) == len(weights)
        return cls(len(members))

    def around(self):
        """For all members."""
        return torch.full((self.count,), 0.2)

    def each(self):
        """For all members."""
        return torch.full((self.count,), 0.5)


@pytest.mark.parametrize("most", [30, 29, 7, 1])  # of more members, some are drawn
@pytest.mark.parametrize(
    "where, told", [("given", 4.0), ("photos", 16.0), ("room", 2.0), ("outside", 1.0)]  # 16^(1/2), 16, 16^(1/4)
)  # fmt: skip
def test_members_are_weighed_by_what_is_seen_of_them(monkeypatch, where, told, most):
    monkeypatch.setattr(merging, "FEWEST_SEEN", 0)
    monkeypatch.setattr(merging, "MOST_DRAWN", most)
    monkeypatch.setattr(merging, "photo_places", lambda content: ("places", "shares") if where == "photos" else None)
    monkeypatch.setattr(merging, "viewpoints", lambda *_: one_view())
    monkeypatch.setattr(merging, "is_room", lambda scene: where == "room")
    monkeypatch.setattr(merging, "Shown", Half)
    for name, value in (("weights_seen", 3.0), ("weights_seen_from", 3.0), ("how_much_seen", 16.0)):
        monkeypatch.setattr(merging, name, lambda *_, value=value: torch.full((30,), value))
    merge_of = merging.Merging(cloud(30), torch.arange(30), one_view() if where == "given" else None)
    assert merge_of.seen.tolist() == [0.5] * 30
    assert merge_of.state.weights.tolist() == pytest.approx([3.0 * 0.2 * told] * 30)


@pytest.mark.parametrize("worth", [-1.0, 0.0, 1.0])
def test_members_change_groups_unless_renders_lose_by_it(monkeypatch, worth):
    scene = cloud(60).replace(means=cloud(60).means + torch.tensor([0.0, 0.0, 4.0]))
    monkeypatch.setattr(merging, "regrouped", lambda scene, members, masses, place, groups: place.roll(1))
    psnrs = iter((30.0 + worth, 30.0))  # of the changed groups, then of those merged
    monkeypatch.setattr(merging.Reference, "best", lambda self, make: Finish())
    monkeypatch.setattr(merging.Reference, "psnr", lambda self, scene: next(psnrs))
    merged = merge(scene, 20, views=one_view())
    monkeypatch.setattr(merging, "ROUNDS", 0)
    monkeypatch.setattr(merging.Reference, "psnr", lambda self, scene: 0.0)
    as_merged = merge(scene, 20, views=one_view())
    assert torch.equal(merged.assignment, as_merged.assignment) == (worth < 0)


def test_a_scene_too_large_to_render_is_rendered_once_it_is_small_enough(monkeypatch):
    scene = wall()
    monkeypatch.setattr(merging, "FEWEST_SEEN", 0)
    monkeypatch.setattr(merging, "MOST_SEEN", len(scene) // 2)
    merged = merge(scene, len(scene) // 4)
    assert merged.finish.psnr is not None and len(merged.scene) == len(scene) // 4
    monkeypatch.setattr(merging, "MOST_SEEN", 0)
    assert merge(scene, len(scene) // 4).finish == Finish()


def test_a_cloud_of_zero_rows_is_merged_in_few_rounds():
    """Broken files have rows of nothing but zeros: half opaque balls of size 1, all at the origin."""
    scene = cloud(1000)
    zeros = Gaussians(*(torch.zeros(400, *value.shape[1:]) for value in scene.tensors()))
    reports = []
    assert len(merge(Gaussians.cat([scene, zeros]), 200, progress=reports.append).scene) == 200
    assert len(reports) < 20


def test_a_scene_that_is_turned_is_merged_as_well():
    scene, neutral = ps.example_room(), (torch.ones(3, dtype=torch.float64), torch.arange(3))
    views = ps.sample_views(scene, 6, 160, 120)
    pictures = [ps.render(scene, view) for view in views]
    reached = []
    for quat in ([1.0, 0.0, 0.0, 0.0], [0.8, 0.4, 0.4, 0.2]):
        quat = torch.nn.functional.normalize(torch.tensor(quat, dtype=torch.float64), dim=0)
        turn = Transform(quat, mirrored=False, gains=neutral[0], channels=neutral[1])
        small = turn.undo(merge(turn.apply(scene), len(scene) // 10).scene)
        reached.append(fmean(finite_psnr(ps.render(small, v), p) for v, p in zip(views, pictures, strict=True)))
    assert abs(reached[0] - reached[1]) < 0.3  # dB; it was 0.5 where directions were those of the world's axes
