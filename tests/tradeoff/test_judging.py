"""The judge: figures are those of the metrics, photos are reduced with their views, times are of drawing."""

import math
from dataclasses import replace
from statistics import fmean

import pytest
import torch
from PIL import Image

import pointsplat_ns as ps
from pointsplat_ns.errors import DataError
from pointsplat_ns.rasterizer import render, render_with_alpha
from pointsplat_ns.tradeoff import judging
from pointsplat_ns.tradeoff.judging import Judge, JudgedViews
from pointsplat_ns.tradeoff.points import picture_path


@pytest.fixture()
def dense(room):
    return ps.load(room)


@pytest.fixture()
def photos(dense, room_views):
    return [(image + 0.1).clamp(0, 1) for image in render(dense, room_views)]


def _covered_psnr(images, dense, views):
    """PSNR, dB, of the mean squared error of all views over the pixels that the dense scene covers."""
    wanted, alphas = zip(*(render_with_alpha(dense, view) for view in views), strict=True)
    error = (images - torch.stack(wanted)).double().square().mean() / torch.stack(alphas).double().mean()
    return -10 * math.log10(error)


def judged(judge: Judge, scene, key="some", **options):
    return judge.judge(scene, key, lambda share: None, **options)


@pytest.fixture()
def judge(dense, room_views, no_lpips):
    """A judge of the room without photos."""
    return Judge(dense, JudgedViews(room_views, None, ""))


def test_figures_are_means_over_views(dense, room_views, photos, tmp_path, no_lpips):
    small = ps.prune(dense, 200, by="opacity")
    got = judged(Judge(dense, JudgedViews(room_views, photos, ""), tmp_path), small)
    renders, wanted = render(small, room_views), render(dense, room_views)
    assert got.against_dense.psnr == pytest.approx(_covered_psnr(renders, dense, room_views), abs=1e-4)
    assert got.against_dense.ssim == pytest.approx(fmean(ps.ssim(renders, wanted).tolist()), abs=1e-5)
    assert got.against_photos.psnr == pytest.approx(fmean(ps.psnr(renders, torch.stack(photos)).tolist()), abs=1e-4)
    assert got.against_dense.lpips is got.against_photos.lpips is None
    again = judged(Judge(dense, JudgedViews(room_views, photos, ""), tmp_path), small)
    assert (again.against_dense, again.against_photos) == (got.against_dense, got.against_photos), "to the bit"


@pytest.fixture()
def clock(dense, room_views, monkeypatch):
    """Views of the dense scene take 10, 40 and 20 ms, those of others a half, a quarter and a fifth of it. The list is
    by how much the machine slows both down in each round; further rounds are not slowed down."""
    slow = [1.0] * judging.ROUNDS
    drawn = []

    def timed(scene, view):
        index = next(i for i, known in enumerate(room_views) if torch.equal(known.viewmat, view.viewmat))
        drawn.append((scene is dense, index))
        share = 1.0 if scene is dense else (1 / 2, 1 / 4, 1 / 5)[index]
        frames = 2 * len(room_views)
        return slow[(len(drawn) - 1) // frames % judging.ROUNDS] * share * (0.010, 0.040, 0.020)[index]

    monkeypatch.setattr(judging, "_timed", timed)
    return slow, drawn


def test_times_are_the_dense_scenes_times_the_median_share_between_its_quartiles(dense, judge, clock):
    got = judged(judge, ps.prune(dense, 200, by="opacity"))
    assert judge.dense_ms == pytest.approx(20.0)
    assert (got.frame_ms_low, got.frame_ms, got.frame_ms_high) == pytest.approx((4.5, 5.0, 7.5))
    assert got.clock_ms == pytest.approx(5.0)


def test_a_machine_that_slows_down_changes_what_the_clock_says_and_not_the_times(dense, judge, clock):
    small, (slow, _) = ps.prune(dense, 200, by="opacity"), clock
    before = judged(judge, small)
    slow[:] = [2.0, 1.5, 7.0]
    after = judged(judge, small)
    assert after.clock_ms == pytest.approx(1.5 * before.clock_ms)
    assert (after.frame_ms, after.frame_ms_low, after.frame_ms_high) == pytest.approx(
        (before.frame_ms, before.frame_ms_low, before.frame_ms_high)
    )


def test_each_frame_is_timed_right_after_the_same_one_of_the_dense_scene(dense, room_views, judge, clock):
    judged(judge, dense[:300])
    views = range(len(room_views))
    assert clock[1] == [(is_dense, view) for _ in range(judging.ROUNDS) for view in views for is_dense in (True, False)]


def test_what_is_not_timed_has_no_times(dense, judge, monkeypatch):
    monkeypatch.setattr(judging, "_timed", lambda *args: pytest.fail("timed"))
    got = judged(judge, dense, timed=False)
    assert math.isnan(got.frame_ms) and math.isnan(got.clock_ms)


def test_pictures_are_what_was_rendered_and_the_photos(dense, room_views, photos, tmp_path, no_lpips):
    judge = Judge(dense, JudgedViews(room_views, photos, ""), tmp_path)
    judged(judge, dense, "dense")
    for view, image in enumerate(render(dense, room_views)):
        for what, wanted in (("dense", image), ("photo", photos[view])):
            with Image.open(picture_path(tmp_path, view, what)) as picture:
                pixels = torch.tensor(picture.getdata()).reshape(36, 48, 3) / 255
            assert (pixels - wanted).abs().max() <= 0.5 / 255 + 1e-6
    assert len(judge.pictures("dense")) == len(list((tmp_path / "pictures").glob("*_dense.png"))) == 3


def test_photos_are_reduced_with_their_views_by_the_mean_of_each_area(room_views):
    photos = [torch.rand(36, 48, 3, generator=torch.Generator().manual_seed(0))] * 3
    small = JudgedViews(room_views, photos, "").resized(24)
    assert (small.views.width, small.views.height) == (24, 18)
    wanted = photos[0].reshape(18, 2, 24, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(small.photos[0], wanted, atol=1e-6)
    assert JudgedViews(room_views, photos, "").resized(48).photos is photos


def test_lpips_is_given_where_weights_are_at_hand(dense, room_views, tmp_path, some_lpips):
    judge = Judge(dense, JudgedViews(room_views, None, ""), tmp_path)
    quality = judged(judge, ps.prune(dense, 100)).against_dense
    assert (quality.lpips is not None and 0 < quality.lpips < 2) == some_lpips
    assert ("LPIPS is missing" in judge.no_lpips) != some_lpips


def test_pictures_too_small_for_ssim_are_refused(dense, room_views, tmp_path):
    with pytest.raises(DataError, match="views are 10 x 36 pixels; expected at least 11 a side"):
        Judge(dense, JudgedViews(replace(room_views, width=10), None, ""), tmp_path)
