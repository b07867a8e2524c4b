"""Pictures of whole scenes: drawn faster, they are what the rasterizer gives at that quality, or enlarged."""

import dataclasses

import pytest
import torch

import pointsplat_ns as ps
from making import assert_same_on_any_threads, box_room
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import pixels_of, projection
from pointsplat_ns.rasterizer import scene as scene_module
from pointsplat_ns.rasterizer.pixel_walk import sum_over_pixels
from pointsplat_ns.rasterizer.projection import project_scene
from pointsplat_ns.views import Views


@pytest.fixture(scope="module")
def room():
    return box_room(0, 400)


@pytest.fixture(scope="module")
def views(room):
    return ps.sample_views(room, 2, 48, 36)


def test_quality_is_handed_on(room, views):
    exact, fast = (ps.render(room, views[0], quality=quality) for quality in ("exact", "fast"))
    psnr = float(ps.psnr(fast, exact))
    assert 30 < psnr < 60, "nearly the same, and not the same"


def test_an_unknown_quality_is_refused(room, views):
    with pytest.raises(ValueError, match="quality"):
        ps.render(room, views, quality="magic")


def test_a_view_goes_to_the_device_of_the_scene_in_the_precision_that_a_render_takes(room, views, monkeypatch):
    given = []
    monkeypatch.setattr(projection, "project", lambda *arguments, **_: given.extend(arguments))
    view = dataclasses.replace(views[0], viewmat=views[0].viewmat.double(), K=views[0].K.double())
    project_scene(room.to(device="meta"), view)  # a device that every machine has, for want of CUDA
    *_, viewmat, K, width, height = given
    assert (viewmat.device.type, viewmat.dtype) == ("meta", torch.float64), "places cameras far from the origin exactly"
    assert (K.device.type, K.dtype) == ("meta", torch.float32) and (width, height) == (48, 36)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_scene_on_cuda_is_projected_from_a_view_on_the_cpu(room, views):
    wanted, seen = project_scene(room, views[0]), project_scene(room.to(device="cuda"), views[0])
    assert torch.equal(seen.ids.cpu(), wanted.ids)
    torch.testing.assert_close(seen.means2d.cpu(), wanted.means2d, rtol=0, atol=1e-3)  # pixels: rounded in another way


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_pixels_of_gaussians_are_sums_of_their_weights(room, views, dtype, compiled):
    scene = room.to(dtype)
    counted = scene.to(torch.promote_types(dtype, torch.float32))
    tolerance = 1e-9 if dtype == torch.float64 else 1e-4
    for view in views:
        seen = project_scene(counted, view)
        weights = sum_over_pixels(
            seen, view.width, view.height, 1,
            lambda block: torch.where(block.alpha > 0, block.alpha * block.before, 0.0).sum(-1, keepdim=True),
        )  # fmt: skip
        wanted = torch.zeros(len(scene), dtype=counted.dtype).index_add_(0, seen.ids, weights[:, 0])
        with torch.no_grad():  # as it is where scenes are merged
            pixels = pixels_of(scene, view, compiled)
        assert pixels.dtype == counted.dtype and float(pixels.sum()) > 0.5 * view.width * view.height
        torch.testing.assert_close(pixels, wanted, rtol=tolerance, atol=tolerance)


def test_pixels_are_the_same_on_any_threads_and_to_rounding_in_several_regions(room, views, monkeypatch):
    whole = pixels_of(room, views[0])
    assert_same_on_any_threads(lambda: [pixels_of(room, view) for view in views])
    monkeypatch.setattr(scene_module, "MEMORY_BUDGET", 32 * 3000)
    torch.testing.assert_close(pixels_of(room, views[0]), whole, rtol=1e-5, atol=1e-6)  # float32, in another order


def test_pixels_behind_saturated_ones_are_zero():
    """More Gaussians than a chunk, the first ones opaque."""
    count = 300
    depths = 1.0 + 0.01 * torch.arange(count)
    scene = Gaussians(
        means=torch.stack([torch.zeros(count), torch.zeros(count), depths], dim=1),
        scales=torch.full((count, 3), 2.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacities=torch.full((count, 1), 8.0),
        features_dc=torch.zeros(count, 3),
        features_rest=torch.zeros(count, 0, 3),
    )
    eye, K = torch.eye(4, dtype=torch.float64)[None], torch.tensor([[[20.0, 0, 12], [0, 20.0, 12], [0, 0, 1]]])
    view = Views(eye, K.double(), 24, 24, torch.zeros(3))[0]
    ours, torchs = (pixels_of(scene, view, compiled) for compiled in (None, False))
    torch.testing.assert_close(ours, torchs, rtol=1e-5, atol=1e-5)
    assert float(ours[0]) > 500 and not ours[5:].any()
