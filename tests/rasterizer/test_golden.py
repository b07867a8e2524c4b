"""Every path of the rasterizer against stored images and gradients of the float64 reference.

They catch what a comparison of two paths of today cannot: that both have changed, with torch or with us.
"""

import re

import pytest
import torch

import golden
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.tiles import Footprints

F32, F64 = torch.float32, torch.float64

STORED = 1e-6
"""Of the largest value: the file holds float32, whose rounding is 6e-8, and depths and gradients are sums of such."""

IMAGE_32 = 1e-5
"""Of the largest value, for float32: ten times what some tens of layers of rounding were seen to become."""

GRADIENT_32 = 1e-4
"""Of a gradient's norm, for float32: ten times what was seen; a gradient is a sum over pixels that partly cancel."""


TORCH = {"compiled": False}
PATHS = {
    "packed": TORCH,
    "dense": {"packed": False, **TORCH},
    "regions": {"memory_budget": 4000, **TORCH},
    "compiled": {},  # where there is a compiler, in float32, of at most four channels
    "compiled in regions": {"memory_budget": 4000},
}
if torch.cuda.is_available():
    PATHS["CUDA"] = {"device": "cuda"}


@pytest.fixture(scope="module")
def stored():
    return golden.stored()


def test_a_changed_file_has_a_written_reason():
    entries = re.findall(r"^- `([0-9a-f]{64})`\n  (.+)$", golden.REASONS.read_text("utf-8"), flags=re.MULTILINE)
    assert entries and entries[-1][0] == golden.digest(), "make it by tests/support/golden.py, which asks for a reason"
    assert all(len(reason) >= 20 for _, reason in entries)
    assert golden.GOLDEN.stat().st_size < 200_000


def test_the_file_holds_the_scenes_and_they_show_something(stored):
    assert stored.keys() == golden.SCENES.keys()
    for name, scene in stored.items():
        assert scene["alphas"].max() > 0.2 and all(scene[f"grad of {part}"].any() for part in golden.NAMES), name


def draw(scene, shape, dtype, device="cpu", **options):
    """What the fast path makes of a stored scene: image, alphas, gradients, in float64."""
    leaves = {name: scene[name].to(device, dtype, copy=True).requires_grad_() for name in golden.NAMES}
    background = torch.tensor([shape.background], device=device, dtype=dtype) if shape.background is not None else None
    renders, alphas, _ = rasterization(
        *leaves.values(), scene["viewmat"][None].to(leaves["means"]), scene["K"][None].to(leaves["means"]),
        golden.WIDTH, golden.HEIGHT, sh_degree=shape.sh_degree, backgrounds=background, render_mode=shape.render_mode,
        rasterize_mode=shape.mode, **options,
    )  # fmt: skip
    grads = torch.autograd.grad(golden.total(renders[0], alphas[0]), list(leaves.values()), materialize_grads=True)
    of_names = {f"grad of {name}": grad for name, grad in zip(golden.NAMES, grads, strict=True)}
    return {
        name: value.detach().to("cpu", F64)
        for name, value in {"image": renders[0], "alphas": alphas[0], **of_names}.items()
    }


def compare(got, wanted, image, gradient):
    for name in ("image", "alphas"):
        off = (got[name] - wanted[name]).abs().max() / wanted[name].abs().max()
        assert off <= image, (name, float(off))
    for name in (f"grad of {part}" for part in golden.NAMES):
        off = (got[name] - wanted[name]).norm() / wanted[name].norm()
        assert off <= gradient, (name, float(off))


@pytest.mark.parametrize("name", golden.SCENES)
def test_the_reference_is_what_it_was(name, stored):
    compare(golden.drawn_by_reference(golden.SCENES[name], stored[name]), stored[name], STORED, STORED)


@pytest.mark.parametrize("options", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("name", golden.SCENES)
def test_the_fast_path_draws_the_stored_images(name, dtype, options, stored):
    tolerances = (STORED, STORED) if dtype == F64 else (IMAGE_32, GRADIENT_32)
    compare(draw(stored[name], golden.SCENES[name], dtype, **options), stored[name], *tolerances)


def test_a_small_budget_does_draw_in_regions(stored, monkeypatch):
    regions = []
    tiles = Footprints.tiles
    monkeypatch.setattr(Footprints, "tiles", lambda self, region: regions.append(region) or tiles(self, region))
    draw(stored["degree 1"], golden.SCENES["degree 1"], F32, memory_budget=4000, **TORCH)
    assert len(set(regions)) > 1
