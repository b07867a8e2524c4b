"""Pictures of small scenes by every path, and drawing a scene."""

import pytest
import torch

import golden
from making import box_room, views_from_within
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.rasterizer import scene as scene_module
from pointsplat_ns.rasterizer.pixel_walk import sum_over_pixels
from pointsplat_ns.rasterizer.projection import project_scene

TORCH = {"compiled": False}

PATHS = {
    "packed": TORCH,
    "dense": {"packed": False, **TORCH},
    "regions": {"memory_budget": 4000, **TORCH},
    "compiled": {},  # where the kernels were built, in float32, of at most four channels
    "compiled in regions": {"memory_budget": 4000},
}

if torch.cuda.is_available():
    PATHS["CUDA"] = {"device": "cuda"}


@pytest.mark.parametrize("options", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize("dtype", golden.TOLERANCES)
@pytest.mark.parametrize("name", golden.SCENES)
def test_every_path_draws_what_the_reference_draws(name, dtype, options):
    golden.compare(
        golden.drawn(name, dtype, **options),
        golden.drawn_by_reference(name),
        *golden.TOLERANCES[dtype],
    )


@pytest.fixture(scope="module")
def room():
    return box_room(0, 400)


@pytest.fixture(scope="module")
def views(room):
    return views_from_within((0.0, 0.0, 0.0), 2, 48, 36)


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


def test_pixels_are_the_same_in_several_passes(room, views, monkeypatch):
    whole = pixels_of(room, views[0])
    monkeypatch.setattr(scene_module, "MOST_PAIRS", 3000)
    torch.testing.assert_close(pixels_of(room, views[0]), whole, rtol=1e-5, atol=1e-6)  # float32, in another order
