"""Pictures of several sizes: few pixels of a large picture are those of the large picture."""

import dataclasses

import pytest
import torch

from making import ball
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.sizes import RendersOfSizes, middle_sized, parse_resolution, sides_of, subsampled, two_sizes
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import EPS2D


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


def test_pictures_larger_than_the_views_own_are_as_from_nearer(views):
    near, full = subsampled(views, 1280, 320), subsampled(views, 640, 320)
    assert (near.width, near.height) == (full.width, full.height) == (320, 240)
    assert near.eps2d == full.eps2d / 4 == EPS2D / 16


def test_a_subsampled_picture_of_its_own_size_is_the_reduced_picture(views):
    small, same = views.resized(320), subsampled(views, 320, 320)
    assert same.eps2d == EPS2D and torch.equal(same.Ks, small.Ks) and (same.width, same.height) == (320, 240)


def test_two_sizes_have_as_many_pixels(views):
    middle, full = two_sizes(views)
    assert (middle.width, middle.height) == (full.width, full.height) == (453, 340)
    assert middle.eps2d == EPS2D and full.eps2d == EPS2D * (453 / 640) ** 2
    small, same = two_sizes(views.resized(200))
    assert small.eps2d == same.eps2d == EPS2D and small.width == same.width == 200


def test_a_picture_that_is_no_larger_than_a_window_has_one_size():
    assert sides_of(320, 200) == (320,) and sides_of(1, 1) == (1,)
    assert sides_of(1080, 1920) == sides_of(1920, 1080)


def test_views_of_a_middle_size(views):
    assert max(middle_sized(views).width, middle_sized(views).height) == sides_of(640, 480)[1]


def test_the_scene_itself_is_not_wrong_at_any_size_and_a_wider_one_is(scene, views):
    renders = RendersOfSizes(scene, views, sides_of(640, 480))
    assert renders.psnrs(scene) == [100.0] * 3
    wider = renders.psnrs(scene.replace(scales=scene.scales + 0.1))
    assert all(5 < psnr < 60 for psnr in wider)
    assert renders.psnr(scene) == 100.0


def test_an_error_of_opacity_alone_counts_before_the_background_that_shows_it(scene, views):
    """Black Gaussians before black: their opacity does not show, and it does before white."""
    black = scene.replace(features_dc=torch.full_like(scene.features_dc, -10.0), features_rest=scene.features_rest * 0)
    renders = RendersOfSizes(black, views, sides_of(640, 480))
    assert renders.psnr(black.replace(opacities=black.opacities - 1)) < 50


@pytest.mark.parametrize("text", ["", "1920", "0x5", "1920x1080x3", "-3x4", "axb", "99999x10", "1.5x2", (3,), (0, 4)])
def test_what_is_no_resolution_is_refused(text):
    with pytest.raises(PointSplatError, match="expected width and height in pixels"):
        parse_resolution(text)


def test_a_resolution_is_read():
    assert parse_resolution(" 640X480".strip()) == (640, 480) and parse_resolution(None) is None
