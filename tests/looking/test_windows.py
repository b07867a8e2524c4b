"""Windows of large pictures: they show what the large picture shows there, at every size."""

from __future__ import annotations

import math

import pytest
import torch

from making import ball
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.settings import DEFAULTS
from pointsplat_ns.looking.windows import (
    WindowRenders,
    middle_sized,
    parse_resolution,
    sides_of,
    window,
    windows_of,
)
from pointsplat_ns.rasterizer import render


@pytest.fixture(scope="module")
def scene():
    return ball(400)


@pytest.fixture(scope="module")
def views(scene):
    return sample_views(scene, 2, 640, 480)


@pytest.mark.parametrize("at", [(0.5, 0.5), (0.0, 0.0), (1.0, 0.3)])
def test_a_window_of_full_size_is_a_crop_of_the_whole_picture(scene, views, at):
    # 3DGS takes the projection of a Gaussian that is centred outside of a picture at the picture's edge, so that large
    # ones there differ between window and whole.
    fine = scene.replace(scales=scene.scales - 3)
    whole, part = render(fine, views[0]), window(views[0], 640, at)
    assert (part.width, part.height) == (DEFAULTS.window_side, 240)
    left = min(max(round(at[0] * 640 - 160), 0), 640 - 320)
    top = min(max(round(at[1] * 480 - 120), 0), 480 - 240)
    crop = whole[top : top + 240, left : left + 320]
    assert float(crop.std()) > 0.01
    assert float((render(fine, part) - crop).abs().mean()) < 1e-4


def test_a_window_beyond_the_full_size_shows_what_is_seen_from_nearer(views):
    near, full = window(views[0], 1280, (0.25, 0.75)), window(views[0], 640, (0.25, 0.75))
    assert (near.width, near.height) == (full.width, full.height)
    torch.testing.assert_close(near.K[:2, :2], 2 * full.K[:2, :2])


def test_the_smallest_window_is_the_reduced_picture(scene, views):
    part = window(views[0], DEFAULTS.window_side, (0.9, 0.1))
    small = views.resized(DEFAULTS.window_side)[0]
    assert (part.width, part.height) == (small.width, small.height)
    torch.testing.assert_close(part.K, small.K)


def test_a_window_has_the_principal_point_of_the_whole_picture(views):
    part = window(views[0], 640, (1.0, 1.0))
    torch.testing.assert_close(part.K[:2, 2], views[0].K[:2, 2] - part.K.new_tensor([320.0, 240.0]))
    assert part.K[0, 0] == views[0].K[0, 0]


def test_a_picture_that_is_no_larger_than_a_window_has_one_size():
    assert sides_of(320, 200) == (320,) and sides_of(1, 1) == (1,)
    assert sides_of(1080, 1920) == sides_of(1920, 1080)


def test_views_of_a_middle_size(views):
    assert max(middle_sized(views).width, middle_sized(views).height) == sides_of(640, 480)[1]


def test_windows_lie_where_the_scene_covers_the_picture(views):
    alpha = torch.zeros(48, 64)
    alpha[0, 63] = 1.0  # the upper right corner
    found = windows_of(views, [alpha, alpha])
    largest = found.views[-1][0]
    assert float(largest.K[0, 2]) == float(views[0].K[0, 2]) - 320 and float(largest.K[1, 2]) == float(views[0].K[1, 2])


@pytest.mark.parametrize("alpha", [torch.zeros(4, 6), torch.full((4, 6), math.nan)])
def test_windows_of_a_picture_of_nothing_lie_in_its_middle(views, alpha):
    found = windows_of(views, [alpha, alpha])
    torch.testing.assert_close(found.views[-1][0].K, window(views[0], 640).K)


def test_several_windows_of_each_view_are_as_one_of_each_repeated_and_whole_pictures_are_drawn_once(scene, views):
    several = WindowRenders(scene, views, each=3)
    repeated = WindowRenders(scene, views[torch.arange(len(views)).repeat_interleave(3)])
    assert [len(one.views) for one in several.references] == [len(views), 3 * len(views), 3 * len(views)]
    wider = scene.replace(scales=scene.scales + 0.1)
    assert several.psnrs(wider) == pytest.approx(repeated.psnrs(wider), abs=1e-9)


def test_the_scene_itself_is_not_wrong_in_any_window_and_a_wider_one_is(scene, views):
    renders = WindowRenders(scene, views)
    assert renders.psnrs(scene) == [100.0] * 3
    wider = renders.psnrs(scene.replace(scales=scene.scales + 0.1))
    assert all(5 < psnr < 60 for psnr in wider)
    assert renders.psnr(scene) == 100.0


def test_an_error_of_opacity_alone_counts_before_the_background_that_shows_it(scene, views):
    """Black Gaussians before black: their opacity does not show, and it does before white."""
    black = scene.replace(features_dc=torch.full_like(scene.features_dc, -10.0), features_rest=scene.features_rest * 0)
    renders = WindowRenders(black, views)
    assert renders.psnr(black.replace(opacities=black.opacities - 1)) < 50


@pytest.mark.parametrize("text", ["", "1920", "0x5", "1920x1080x3", "-3x4", "axb", "99999x10", "1.5x2", (3,), (0, 4)])
def test_what_is_no_resolution_is_refused(text):
    with pytest.raises(PointSplatError, match="expected width and height in pixels"):
        parse_resolution(text)


def test_a_resolution_is_read():
    assert parse_resolution(" 640X480".strip()) == (640, 480) and parse_resolution(None) is None
