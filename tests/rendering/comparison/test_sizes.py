"""Size changes that renders choose, and how near a scene is to the dense one."""

import dataclasses
import math
from statistics import fmean

import pytest
import torch

from making import ball, cloud
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import psnr, ssim
from pointsplat_ns.rendering import render, render_with_alpha
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.sizes import (
    RendersOfSizes,
    parse_resolution,
    sides_of,
    subsampled,
)
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def scene():
    return ball(400)


@pytest.fixture(scope="module")
def views(scene):
    return sample_views(scene, 2, 640, 480)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_a_subsampled_picture_is_every_so_many_th_pixel_of_the_large_one(scene, views, mode):
    wide = dataclasses.replace(views, rasterize_mode=mode, width=642)
    every_third = render(scene, wide[0])[1::3, 1::3]  # the middle pixel of each block of 3 x 3
    few = render(scene, subsampled(wide, 642, 214)[0])
    assert float(every_third.std()) > 0.01
    torch.testing.assert_close(few, every_third, atol=2e-5, rtol=0)


def test_the_scene_itself_is_not_wrong_at_any_size_and_a_wider_one_is(scene, views):
    renders = RendersOfSizes(scene, [subsampled(views, side) for side in sides_of(640, 480)])
    assert renders.psnrs(scene) == [100.0] * 3
    wider = renders.psnrs(scene.replace(scales=scene.scales + 0.1))
    assert all(5 < psnr < 60 for psnr in wider)
    assert renders.psnr(scene) == 100.0


def test_an_error_of_opacity_alone_counts_on_some_background(scene, views):
    """Black Gaussians before black: their opacity does not show, and it does before white."""
    black = scene.replace(
        features_dc=torch.full_like(scene.features_dc, -10.0), features_rest=scene.features_rest * 0
    )
    renders = RendersOfSizes(black, [subsampled(views, side) for side in sides_of(640, 480)])
    assert renders.psnr(black.replace(opacities=black.opacities - 1)) < 50


@pytest.mark.parametrize(
    "text", ["", "1920", "0x5", "1920x1080x3", "-3x4", "axb", "99999x10", "1.5x2", (3,), (0, 4)]
)
def test_what_is_no_resolution_is_refused(text):
    with pytest.raises(PointSplatError, match="expected width and height in pixels"):
        parse_resolution(text)


SCENE = cloud(200)


def test_closeness_is_that_of_the_metrics_over_covered_pixels(hollow_ball, ball_views):
    reference = DenseReference(hollow_ball, ball_views)
    kept = hollow_ball[:900]
    shares = []
    close = reference.closeness(kept, shares.append)
    pictures = torch.stack([render(kept, ball_views[i]) for i in range(4)]).double()
    wanted = torch.stack(reference.renders).double()
    covered = torch.tensor(reference.covered).double()
    each = psnr(pictures, wanted) + 10 * covered.log10()
    overall = -10 * torch.log10((pictures - wanted).square().mean() / covered.mean())
    # 1e-5: shares in float32 here, and float64 means, summed in another order
    assert close.psnr == pytest.approx(float(overall), abs=1e-5)
    assert close.worst == pytest.approx(float(each.min()), abs=1e-5) and close.worst < close.psnr
    drawn = fmean(
        float((render_with_alpha(hollow_ball, view)[1] > 0).double().mean()) for view in ball_views
    )
    assert 0.1 < drawn < 0.9 and reference.ssim(kept) == pytest.approx(
        1 - (1 - float(ssim(pictures, wanted).mean())) / drawn, abs=5e-5
    )  # float32 there
    assert reference.psnr(kept) == (close.psnr, close.worst) and shares == [0.25, 0.5, 0.75, 1.0]
    assert reference.closeness_of(render(kept, view) for view in ball_views) == close
    itself = reference.closeness(hollow_ball)
    assert itself.psnr == itself.worst == math.inf and reference.ssim(hollow_ball) == pytest.approx(
        1.0
    )


@pytest.mark.parametrize("both_backgrounds", [False, True])
def test_empty_margins_bring_nothing_closer(both_backgrounds):
    narrow = _ahead()
    K = narrow.Ks.clone()
    K[:, 0, 2] += narrow.width
    wide = dataclasses.replace(narrow, Ks=K, width=3 * narrow.width)
    one, other = (DenseReference(SCENE, views, both_backgrounds) for views in (narrow, wide))
    assert 0 < other.covered[0] == pytest.approx(one.covered[0] / 3, rel=1e-6)
    assert other.psnr(SCENE[:150]) == pytest.approx(one.psnr(SCENE[:150]), abs=1e-3)


def test_what_is_covered_is_where_the_background_does_not_show():
    views = _ahead()
    white, black = (
        dataclasses.replace(views, background=torch.full((3,), value)) for value in (1.0, 0.0)
    )
    shows_through = float((render(SCENE, white) - render(SCENE, black)).mean())
    [covered] = DenseReference(SCENE, views).covered
    assert covered == pytest.approx(1 - shows_through, abs=1e-3) and 0.05 < covered < 0.5


def test_where_the_dense_scene_covers_nothing_all_pixels_count():
    behind = _ahead(-5.0)
    nothing = DenseReference(SCENE, behind)
    assert nothing.covered == (0.0,) and nothing.psnr(SCENE)[0] == math.inf
    moved = SCENE.replace(means=SCENE.means + torch.tensor([0.0, 0.0, 10.0]))
    assert nothing.psnr(moved)[0] == pytest.approx(
        float(psnr(render(moved, behind[0]), nothing.renders[0])), abs=1e-4
    )


def _ahead(distance: float = 5.0) -> Views:
    """A view of all of :data:`SCENE`, a unit cube, from a distance."""
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-0.5, -0.5, distance])
    K = torch.tensor([[96.0, 0.0, 32.0], [0.0, 96.0, 32.0], [0.0, 0.0, 1.0]])
    return Views(viewmat[None], K[None], 64, 64, torch.zeros(3))
