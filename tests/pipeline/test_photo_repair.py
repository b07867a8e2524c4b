"""Training a smaller scene on photos: what it gains where no step looked, which pixels count, and
how it ends."""

import dataclasses
import math
import random

import pytest
import torch

import pointsplat_ns as ps
from making import FewViews, views_from_within
from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.pipeline import photo_repair as module
from pointsplat_ns.pipeline import repair_budget
from pointsplat_ns.pipeline import stages as stages_module
from pointsplat_ns.pipeline.compact_scene import compact_scene, compact_to_quality
from pointsplat_ns.pipeline.optimiser import (
    RATES,
    Adam,
    AdamSettings,
    Example,
    extent,
    gradients_of,
    size_factors,
)
from pointsplat_ns.pipeline.options import CompactOptions
from pointsplat_ns.pipeline.photo_repair import photo_repair, reallocated, split
from pointsplat_ns.pipeline.photos import examples
from pointsplat_ns.pipeline.photos.examples import every_kth_pixel, mean_psnr
from pointsplat_ns.pipeline.quality import through_file
from pointsplat_ns.pipeline.repair_budget import PHOTO_STEPS, STEPS, PhotoBudget
from pointsplat_ns.pruning import prune
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.scene.views import EPS2D
from pointsplat_ns.tools.wording import stage_text
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setitem(PHOTO_STEPS, "quick", 40)
    monkeypatch.setitem(STEPS, "quick", 4)


@pytest.fixture(scope="module")
def pruned(hollow_ball):
    return prune(hollow_ball, 300, "merge")


@pytest.fixture(scope="module")
def photos(hollow_ball):
    """Photos of the ball in other colours than the dense scene has: only photos can teach them."""
    views = views_from_within((5.0, 0.0, 0.0), 18, 48, 36)
    photographed = hollow_ball.replace(features_dc=hollow_ball.features_dc + 0.4)
    return [Example(view, render(photographed, view).detach()) for view in views]


def test_unseen_photos_are_in_no_step_and_the_others_in_turn(
    hollow_ball, pruned, photos, monkeypatch
):
    taken = []
    for place in (module, examples):
        monkeypatch.setattr(
            place,
            "every_kth_pixel",
            lambda photo, *rest: taken.append(id(photo)) or every_kth_pixel(photo, *rest),
        )
    photo_repair(pruned, hollow_ball, photos, FewViews(hollow_ball), PhotoBudget("quick"))
    unseen = [id(photo) for photo in photos[::8]]
    # 35 of 40 steps take a photo, 5 a sampled view; 12 photos of steps and 3 others are compared.
    assert len(taken) == 35 + 2 * 15 and taken[:15] == taken[-15:] and taken[12:15] == unseen
    assert {*taken[15:30]} == {*taken[30:45]} == {id(photo) for photo in photos} - {*unseen}


def test_each_lap_has_the_photos_in_another_order_and_other_pixels(hollow_ball, monkeypatch):
    taken = []

    def every_kth(photo, side, device, generator):
        taken.append((photo, generator.randrange(1 << 20)))
        return photo

    monkeypatch.setattr(module, "every_kth_pixel", every_kth)
    photos_alone = dataclasses.replace(module.PHOTO_REPAIR, dense_every=10**9)
    monkeypatch.setattr(module, "PHOTO_REPAIR", photos_alone)
    numbered = dict(enumerate("abcdefg"))
    found = module._examples(numbered, [*numbered], hollow_ball, FewViews(hollow_ball), 64)
    for _ in range(3 * 7):
        next(found)
    names = "".join(name for name, _ in taken)
    laps = [names[start : start + 7] for start in (0, 7, 14)]
    assert all(sorted(lap) == [*"abcdefg"] for lap in laps) and len(set(laps)) == 3
    assert len({offset for _, offset in taken}) == 21


@pytest.mark.parametrize(
    ("faster", "unseen", "most_lost", "stages", "text"),
    [
        (8.0, 0.4, 1.5, ["photos"], "trained on 15 photos by 40"),
        (8.0, -0.4, 20.0, ["repair", "photos"], "trained on 15 photos by 40"),
        (8.0, -0.4, 1.5, ["repair", "photos"], "other photos lose"),
        (1e4, 0.4, 1.5, ["repair", "photos"], "gain below 0.1 dB"),
    ],
)
def test_a_scene_is_kept_that_gains_in_its_photos_and_harms_no_others(
    faster, unseen, most_lost, stages, text, hollow_ball, monkeypatch
):
    """Steps that are far too long harm; photos in which colours go the other way lose, and a repair
    follows."""
    settings = dataclasses.replace(
        module.PHOTO_REPAIR, adam=AdamSettings(faster), most_lost=most_lost
    )
    for place in (module, stages_module):
        monkeypatch.setattr(place, "PHOTO_REPAIR", settings)
    scenes = [
        hollow_ball.replace(features_dc=hollow_ball.features_dc + change)
        for change in (unseen, 0.4)
    ]
    views = views_from_within((5.0, 0.0, 0.0), 18, 48, 36)
    photos = [
        Example(view, render(scenes[index % 8 > 0], view).detach())
        for index, view in enumerate(views)
    ]
    options = CompactOptions(keep=300, photos=True).completed()
    result = compact_scene(hollow_ball, options, FewViews(hollow_ball), photos=photos)
    stage = result.stages[-1]
    kept = text.startswith("trained")
    assert [stage.stage for stage in result.stages[1:]] == stages
    assert stage.accepted == kept and text in stage_text(stage)
    assert (result.scene is stage.scene) == kept
    assert stage.photos is not None
    assert stage.photos.before == stage.photos.against(result.stages[-2].scene, photos).before


@pytest.mark.parametrize(
    ("large", "side", "stages"), [(299, 320, ["repair", "photos"]), (300, 160, ["photos"])]
)
def test_a_large_scene_is_repaired_first_and_more_pixels_are_drawn(
    large, side, stages, hollow_ball, photos, monkeypatch
):
    settings = dataclasses.replace(module.PHOTO_REPAIR, large=large)
    sides = set()
    for place in (module, stages_module):
        monkeypatch.setattr(place, "PHOTO_REPAIR", settings)
    monkeypatch.setattr(
        module,
        "every_kth_pixel",
        lambda photo, side, *rest: sides.add(side) or every_kth_pixel(photo, side, *rest),
    )
    monkeypatch.setattr(repair_budget, "FEW_GAUSSIANS", 75)
    options = CompactOptions(keep=300, photos=True).completed()
    result = compact_scene(hollow_ball, options, FewViews(hollow_ball), photos=photos)
    last = result.stages[-1]
    assert (
        [stage.stage for stage in result.stages[1:]] == stages and last.accepted and sides == {side}
    )
    assert last.photos is not None
    assert last.photos.before == mean_psnr(
        result.stages[-2].scene, photos, module._photo_roles(len(photos))[1]
    )


def test_auto_finds_the_smallest_file_that_loses_little_in_held_out_photos(hollow_ball, photos):
    asked = CompactOptions(keep="auto", photos=True, target_format=".sog")
    options = dataclasses.replace(asked.completed(), most_lost=-2.0)  # gains 2 dB by the photos
    training = photos[1:]
    held_out = photos[::8]
    found = compact_to_quality(
        hollow_ball, options, FewViews(hollow_ball), photos=training, held_out=held_out
    )
    before, after = (
        mean_psnr(s, held_out, [0, 1, 2])
        for s in (hollow_ball, through_file(found.scene, format_to_write(".sog"))[1])
    )
    assert 2.0 <= after - before < 3.0 and len(found.scene) < 0.7 * len(hollow_ball)
    assert found.target is not None
    assert (found.target.photos, found.target.psnr) == (3, after)
    assert found.target.dense_psnr == before and found.target.tried > 1
    with pytest.raises(DataError, match="there are no held-out photos"):
        compact_to_quality(hollow_ball, options, FewViews(hollow_ball), photos=training)


def test_ctrl_c_gives_the_scene_so_far(hollow_ball, pruned, photos):
    before = [value.clone() for value in pruned.tensors()]

    def stop(share: float) -> None:
        if share > 0.6:
            raise KeyboardInterrupt

    trained = photo_repair(
        pruned, hollow_ball, photos, FewViews(hollow_ball), PhotoBudget("quick"), stop
    )
    assert trained.interrupted and trained.steps == 25 and trained.after > trained.before + 0.5
    assert (trained.used, trained.compared, len(trained.scene)) == (15, 12, 300)
    assert all(torch.equal(a, b) for a, b in zip(before, pruned.tensors(), strict=True)), (
        "the input was changed"
    )


def test_one_photo_is_too_few(hollow_ball, pruned, photos):
    with pytest.raises(DataError, match="1 photos to train on; expected at least two"):
        photo_repair(pruned, hollow_ball, photos[:1], FewViews(hollow_ball), PhotoBudget("quick"))


def test_gaussians_move_by_a_share_of_their_own_size(hollow_ball, pruned, photos):
    """The same steps in scenes of any scale, and next to none where a size is none."""
    adam = Adam(pruned, AdamSettings(), {**RATES, "means": 0.25})
    adam.observe(gradients_of(pruned, *photos[0]))
    moves = adam.moves(1.0, size_factors(pruned, extent(pruned)))["means"].abs()
    middle = pruned.scales.exp().median(dim=1).values
    seen = moves.amax(1) > 0
    assert int(seen.sum()) > 50
    assert torch.allclose(
        moves.amax(1)[seen], 0.25 * middle[seen], rtol=1e-4
    )  # Adam's first step has length 1


def test_sizes_at_their_extremes_move_nothing_to_infinity(pruned):
    logs = [
        (-math.inf, -math.inf, -2.0),
        (-200.0, -150.0, 0.0),
        (-1e-3, 0.0, 88.0),
        (300.0, 200.0, 100.0),
    ]
    scales = torch.tensor([*logs, (math.inf,) * 3, (math.nan,) * 3])
    scene = pruned[: len(scales)].replace(scales=scales)
    shares = [
        size_factors(scene.map(lambda value, to=to: value.to(to)), 4.0)
        for to in (torch.float32, torch.float64)
    ]
    assert shares[0][:, 1:].eq(1).all()
    assert torch.allclose(shares[0].double(), shares[1], rtol=1e-5, atol=1e-30)
    assert shares[1][:, 0].tolist() == pytest.approx([0.0, math.exp(-150) / 4, 0.25, 1.0, 1.0, 0.0])


@pytest.mark.parametrize("generator", [None, random.Random(3)])
def test_every_kth_pixel_of_a_photo_is_what_its_view_draws(hollow_ball, generator):
    view = sample_views(hollow_ball, 1, 159, 120, seed=2)[0]
    whole = Example(view, render(hollow_ball, view).detach(), torch.rand(120, 159, 1) < 0.5)
    part = every_kth_pixel(whole, 53, CPU, generator)
    assert (part.view.width, part.view.height, part.view.eps2d) == (53, 40, EPS2D / 9)
    assert (
        part.target.shape == (40, 53, 3)
        and part.mask is not None
        and part.mask.shape == (40, 53, 1)
    )
    # 3DGS bounds the projection at 1.3 times the picture, whose middle moves a little.
    assert float((render(hollow_ball, part.view) - part.target).abs().mean()) < 2e-4
    assert float(part.target.std()) > 0.05
    assert every_kth_pixel(whole, 100, CPU).target.shape == (120, 159, 3)


def test_masked_pixels_neither_pull_nor_count(hollow_ball, pruned, photos):
    mask = torch.zeros(36, 48, 1, dtype=torch.bool)
    mask[:, :24] = True
    wrong = [
        photo._replace(target=torch.where(mask, photo.target, 1 - photo.target), mask=mask)
        for photo in photos
    ]
    right = [photo._replace(mask=mask) for photo in photos]
    first, second = (gradients_of(pruned, *some[1]) for some in (wrong, right))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert any(float(value.abs().max()) > 0 for value in first.values())
    assert module.mean_psnr(pruned, wrong, [0, 8]) == module.mean_psnr(pruned, right, [0, 8])


def test_a_run_is_compacted_with_its_photos(trained_walls):
    (config,) = (trained_walls / "wall-a").rglob("config.yml")
    result = ps.compact(config.parent, "50%", effort="quick", photos=True)
    assert result.stages[-1].stage == "photos" and result.photo_gain.after > 5


def test_halves_lie_on_both_sides_along_the_longest_axis(hollow_ball):
    scene = hollow_ball[:5].replace(
        scales=torch.tensor([[-3.0, -1.0, -2.0]] * 4 + [[-math.inf, -4.0, 0.0]])
    )
    halves = split(scene, torch.tensor([4, 1]))
    assert len(halves) == 7
    for name, value in scene.items():
        assert torch.equal(dict(halves.items())[name][:3], value[[0, 2, 3]]), name
        if name not in ("means", "scales"):
            assert torch.equal(dict(halves.items())[name][3:], value[[4, 1, 4, 1]]), name
    matrices = rotation_matrices(scene.quats)
    for whole, axis in ((4, 2), (1, 1)):
        first = 3 + (whole == 1)
        second = 5 + (whole == 1)
        apart = (halves.means[first] - halves.means[second]) / 2
        size = scene.scales[whole, axis].exp()
        assert torch.allclose(apart, 0.5 * size * matrices[whole, :, axis], atol=1e-6)
        assert torch.allclose(
            (halves.means[first] + halves.means[second]) / 2, scene.means[whole], atol=1e-6
        )
        change = halves.scales[first] - scene.scales[whole]
        assert float(change[axis]) == pytest.approx(math.log(math.sqrt(1 - 0.5**2)), abs=1e-6)
        assert torch.equal(halves.scales[first], halves.scales[second])
        assert halves.scales[first].isfinite().tolist() == scene.scales[whole].isfinite().tolist()


def test_what_pulls_becomes_two_and_the_number_stays(hollow_ball):
    scene = hollow_ball[:200]
    left = scene.means[:, 0] < scene.means[:, 0].median()
    moved = reallocated(scene, left.float(), 0.2, FewViews(hollow_ball).for_merging())
    assert len(moved) == 200 and bool(moved.usable().all())
    assert int((moved.means[:, 0] < scene.means[:, 0].median()).sum()) > int(left.sum())
    nothing = reallocated(scene, left.float(), 0.0, FewViews(hollow_ball).for_merging())
    assert all(torch.equal(a, b) for a, b in zip(nothing.tensors(), scene.tensors(), strict=True))


def test_scenes_of_too_few_finite_gaussians_stay(hollow_ball):
    scene = hollow_ball[:50]
    broken = scene.replace(means=scene.means.masked_fill(torch.arange(50)[:, None] < 20, math.nan))
    views = FewViews(hollow_ball).for_merging()
    assert reallocated(broken, torch.arange(50.0), 0.2, views) is broken
    mended = reallocated(broken, torch.arange(50.0), 0.6, views)
    assert len(mended) == 50 and bool(mended.usable().all())
