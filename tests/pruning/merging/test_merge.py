"""Merging of Gaussians: exact counts, what is preserved, and what must survive at the extremes."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from making import cloud, same, splats, views_from_within
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pruning.baselines import opacity_score, random_score
from pointsplat_ns.pruning.merging import MERGING, Merger, merge, merge_levels
from pointsplat_ns.pruning.merging.groups import deepened
from pointsplat_ns.pruning.paper import select
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.sizes import RendersOfSizes
from pointsplat_ns.rendering.constants import ALPHA_MAX
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.poses import look_at

pytestmark = pytest.mark.usefixtures("quick")

RENDERED = replace(MERGING, min_count_rendered=0, sampled_views=8)
"""Settings with which the smallest scenes are rendered."""


def wall(side: int = 40, seed: int = 0) -> Gaussians:
    """A flat wall of round disks, of a smooth colour gradient, that covers itself several times."""
    g = torch.Generator().manual_seed(seed)
    axis = torch.linspace(-1, 1, side)
    x, y = (v.reshape(-1) for v in torch.meshgrid(axis, axis, indexing="xy"))
    n = side * side
    means = torch.stack([x, y, torch.zeros(n)], 1) + 0.004 * torch.randn(n, 3, generator=g)
    colours = torch.stack([x, y, -x], 1)
    return splats(means, [math.log(2 / side), math.log(2 / side), -7.0], 1.5, colours)


def test_what_is_merged_with_nothing_is_unchanged_to_the_bit():
    scene = cloud(200)
    merged = merge(scene, 150)
    single = (merged.assignment.bincount() == 1).nonzero()[:, 0]
    assert len(single) > 50
    where = torch.stack([(merged.assignment == index).nonzero()[0, 0] for index in single])
    assert same(merged.scene[single], scene[where])
    scene.means[3] = math.nan
    assert same(
        *(
            some.map(lambda value: value.nan_to_num(7.0))
            for some in (merge(scene, 200).scene, scene)
        )
    )


def test_deepening_grows_with_the_number_of_members_up_to_opaque():
    alphas = torch.tensor([0.0, 1e-12, 0.3, 0.3, 0.3, 0.9, 1.0], dtype=torch.float64)
    counts = torch.tensor([10**6, 16, 1, 2, 16, 10**6, 10**6])
    most = ALPHA_MAX
    want = torch.tensor(
        [0, 2e-12, 0.3, 1 - 0.7 ** (2**0.25), 1 - 0.7**2, most, most], dtype=torch.float64
    )
    # rel: 1 - (1 - a)^p to all digits even where a is far below float64's spacing at 1
    torch.testing.assert_close(deepened(alphas, counts, 0.25, 0.99), want, rtol=1e-11, atol=0)
    assert (
        float((deepened(alphas.float(), counts, 0.25, 0.99) - want).abs().max()) < 1e-6
    )  # float32, 7 digits


def extreme_scenes() -> dict[str, Gaussians]:
    base = cloud(60)
    flat, giant, spread = (base.scales.clone() for _ in range(3))
    flat[:, 2] = -math.inf
    giant[7] = 80.0
    spread[::2] = 80.0
    spread[1::2] = -80.0
    far = base.means.clone()
    far[0] = 1e7
    logits = base.opacities.clone()
    logits[::2] = math.inf
    logits[1::2] = -math.inf
    return {
        "log-scales of +-80": base.replace(scales=spread),
        "points of colour": base.replace(
            scales=torch.full_like(base.scales, -60.0), features_dc=base.features_dc * 1e30
        ),
        "needles": base.replace(scales=base.scales + torch.tensor([20.0, -20.0, -20.0])),
        "huge and far": base.replace(
            means=base.means * 1e30, scales=torch.full_like(base.scales, 60.0)
        ),
        "nearly transparent": base.replace(opacities=torch.full_like(base.opacities, -300.0)),
        "a single giant": base.replace(scales=giant),
        "a zero axis": base.replace(scales=flat),
        "zero scales": base.replace(scales=torch.full_like(base.scales, -math.inf)),
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


@pytest.mark.parametrize("k", [1, 20])
@pytest.mark.parametrize("name", list(extreme_scenes()))
def test_extremes_give_k_drawable_gaussians(name, k):
    scene = extreme_scenes()[name]
    merged = merge(
        scene, k, views=views_from_within((-2.0, 0.5, 0.5), 1, 64, 64) if k == 20 else None
    ).scene
    assert len(merged) == k and merged.dtype == scene.dtype
    assert bool(merged.usable().all())


def test_the_invisible_go_first_and_the_least_opaque_of_them_before():
    scene = cloud(50)
    scene.opacities[:20, 0] = -torch.arange(10.0, 30.0)
    merged = merge(scene, 30)
    assert bool((merged.assignment[:20] == -1).all()) and same(merged.scene, scene[20:])
    assert same(merge(scene, 33).scene, Gaussians.cat([scene[:3], scene[20:]]))
    scene.means[30, 1] = math.nan
    scene.scales[31] = math.inf
    scene.features_dc[32] = math.nan
    merged = merge(scene, 25)
    assert merged.assignment[[30, 31, 32]].tolist() == [-1, -1, -1] and bool(
        merged.scene.usable().all()
    )


def test_many_gaussians_at_one_place_are_merged_in_few_rounds():
    reports = []
    assert (
        len(
            merge(
                cloud(1500).replace(means=torch.zeros(1500, 3)), 15, progress=reports.append
            ).scene
        )
        == 15
    )
    assert len(reports) < 30


def test_a_merger_gives_what_merging_alone_gives_in_any_order_of_counts():
    faint = wall(8, seed=1).replace(opacities=torch.full((64, 1), -9.0))
    scene = Gaussians.cat([wall(20), faint])
    settings = replace(RENDERED, sampled_views=4, finish_views=1)
    merger = Merger(scene, settings=settings)
    for k in (150, 405, 149, len(scene)):
        merged = merger.merged(k)
        alone = merge(scene, k, settings=settings)
        assert same(merged.scene, alone.scene) and torch.equal(merged.assignment, alone.assignment)
    for k in (0, len(scene) + 1):
        with pytest.raises(BudgetError):
            merger.merged(k)


@pytest.mark.parametrize("counts", [[0], [-1], [51], [10, 10], [10, 20], [5, 0]])
def test_impossible_counts_and_levels_that_do_not_descend_are_an_error(counts):
    with pytest.raises(BudgetError, match="expected (1 to 50|descending counts)"):
        merge_levels(cloud(50), counts)


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


def test_the_size_of_the_units_and_the_place_of_the_origin_do_not_matter():
    scene = cloud(300)
    want = merge(scene, 60, settings=RENDERED)
    for factor, shift in ((1e-3, 0.0), (1.0, 64.0)):
        moved = scene.replace(
            means=scene.means * factor + shift, scales=scene.scales + math.log(factor)
        )
        got = merge(moved, 60, settings=RENDERED)
        # float32 positions 64 units away have 4e-6 left, so a few ties may fall otherwise
        assert float((got.assignment == want.assignment).float().mean()) > 0.9, (factor, shift)
        assert got.size_change == pytest.approx(want.size_change, abs=0.03)


@pytest.mark.parametrize(
    ("changes", "rendered"),
    [
        ({"max_count_rendered": 800}, True),
        ({"finish_views": 0}, False),
        ({"sampled_views": 0}, False),
        ({"min_count_rendered": 2000}, False),
    ],
)
def test_a_scene_is_rendered_once_it_is_small_enough_unless_turned_off(changes, rendered):
    merged = merge(wall(), 400, settings=replace(RENDERED, **changes))  # of 1600
    assert len(merged.scene) == 400
    assert (merged.size_change != 0) == rendered


def test_more_than_can_be_drawn_is_an_error():
    scene = cloud(50)
    scene.means[:10] = math.nan
    with pytest.raises(BudgetError, match="40 of 50"):
        merge(scene, 45)


def points(count: int = 3000, log_scale: float = -5.0) -> Gaussians:
    """The wall of a gradient, as points far below a pixel of any view that shows all of it."""
    g = torch.Generator().manual_seed(5)
    across = 2 * torch.rand(count, 2, generator=g) - 1
    means = torch.cat([across, torch.zeros(count, 1)], dim=1)
    return splats(means, log_scale, 1.0, torch.stack([across[:, 0], across[:, 1], across[:, 0]], 1))


def ahead(distance: float, focal: float = 90.0) -> Views:
    """Two views along z."""
    eyes = torch.tensor([[0.0, 0.0, -distance], [0.1 * distance, 0.0, -distance]]).double()
    K = torch.tensor([[focal, 0.0, 48.0], [0.0, focal, 36.0], [0.0, 0.0, 1.0]]).double()
    viewmats = look_at(eyes, torch.zeros_like(eyes))
    return Views(viewmats, K.repeat(2, 1, 1), 96, 72, torch.zeros(3))


def test_points_stay_as_bright_as_their_blur_makes_them():
    """Without blur they have a tenth of the mass, and most of their light is lost."""
    scene = points()
    views = ahead(3.0)
    light = sum(float(render(scene, view).sum()) for view in views)
    lost = {}
    for blur in (0.0, 1.0):
        small = merge(scene, 1000, views=views, settings=replace(MERGING, blur=blur)).scene
        lost[blur] = abs(1 - sum(float(render(small, view).sum()) for view in views) / light)
    assert lost[1.0] < 0.25 < lost[0.0], lost


def dressed(kind: str) -> Gaussians:
    """Points that touch in an image, points that do not, or needles; of all opacities."""
    count = {"dense": 3000, "dust": 300, "needles": 600}[kind]
    scene = points(count, -9.0)
    g = torch.Generator().manual_seed(6)
    scales = scene.scales.clone()
    scales[:, 0] = -2.5 if kind == "needles" else -9.0
    return scene.replace(
        scales=scales,
        quats=torch.randn(count, 4, generator=g),
        opacities=(2 * torch.randn(count, 1, generator=g)).clamp_min(-5.0),
    )


@pytest.mark.parametrize("keep", [0.1, 0.3])
@pytest.mark.parametrize("kind", ["dense", "dust", "needles"])
def test_points_and_needles_are_no_worse_merged_than_selected(kind, keep):
    scene = dressed(kind)
    count = int(keep * len(scene))
    views = ahead(3.0)
    reference = RendersOfSizes(scene, [views])
    selections = (select(score(scene), count) for score in (opacity_score, random_score))
    selected = max(reference.psnr(scene[rows]) for rows in selections)
    merged = merge(scene, count, views=views)
    assert reference.psnr(merged.scene) >= selected - 1e-3  # dB, of rounded units of length
    assert merged.assignment.unique().tolist() == list(range(count)), "nothing is dropped"
    if kind == "dust":  # points that do not touch each other are selected
        rows = scene.opacities[:, 0].topk(count).indices.sort().values
        assert same(merged.scene, scene[rows])
        assert merged.assignment[rows].tolist() == list(range(count))


@pytest.mark.parametrize("distance", [1e-3, 3.0, 1e3, 1e12])
@pytest.mark.parametrize("log_scale", [-math.inf, -60.0, -9.0, 0.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_blurs_of_any_size_leave_finite_gaussians(distance, log_scale, dtype):
    """Beside Gaussians of any size, at one place too, after one level and after several."""
    scene = points(300, log_scale).to(dtype)
    scene.means[:100] = 0.5
    views = ahead(distance)
    results = [merge(scene, 40, views=views), *merge_levels(scene, [120, 40], views=views)]
    for merged in results:
        assert bool(merged.scene.usable().all()) and len(merged.scene) in (40, 120)
        several = (merged.assignment.bincount() > 1).nonzero()[:, 0]
        assert bool(merged.scene.scales[several].isfinite().all())


def test_a_pair_much_larger_than_its_blur_is_merged_as_without():
    scene = cloud(200)
    views = ahead(3.0, focal=1e6)
    found, wanted = (
        merge(scene, 150, views=views, settings=replace(MERGING, blur=blur, finish_views=0)).scene
        for blur in (1.0, 0.0)
    )
    # tolerance: blurs are 3e-12 of variances of 0.0025, rounded to float32
    for name in ("means", "scales", "opacities"):
        torch.testing.assert_close(
            getattr(found, name), getattr(wanted, name), rtol=1e-4, atol=1e-4
        )
