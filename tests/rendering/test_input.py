"""What is given to the rasterizer."""

import math

import pytest
import torch

from making import camera_askew, splats_in_view
from pointsplat_ns.rendering import rasterization

F64 = torch.float64

NAMES = ("means", "quats", "scales", "opacities", "colors")

BAD = [
    ("means", math.nan),
    ("means", math.inf),
    ("means", -math.inf),
    ("quats", math.nan),
    ("quats", math.inf),
    ("scales", math.nan),
    ("scales", math.inf),
    ("scales", -0.1),
    ("opacities", math.nan),
    ("opacities", math.inf),
    ("opacities", -0.5),
    ("colors", math.nan),
    ("colors", math.inf),
    ("colors", -math.inf),
]


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("sh_degree", [None, 0, 3])
def test_what_has_no_meaning_is_skipped_and_counted_with_a_zero_gradient(dtype, sh_degree):
    scene = [t.to(dtype) for t in splats_in_view(50, 11, scale=-2.5)]
    if sh_degree is None:
        scene[4] = scene[4][:, :5, 0]
    view, K = (t.to(dtype)[None] for t in camera_askew())
    scene[3] = scene[3].clamp_min(0.1)
    scene[0][:, :2] *= 0.2  # all in sight
    clean, clean_alpha, meta = rasterization(
        *[t[len(BAD) :] for t in scene], view, K, 37, 29, sh_degree=sh_degree
    )
    assert meta["skipped"] == 0
    for row, (name, value) in enumerate(BAD):
        scene[NAMES.index(name)][row].view(-1)[0] = value
    leaves = [t.clone().requires_grad_() for t in (*scene, view)]
    image, alpha, meta = rasterization(
        *leaves, K, 37, 29, sh_degree=sh_degree, render_mode="RGB+ED"
    )
    assert meta["skipped"] == len(BAD)
    tolerance = 1e-12 if dtype == F64 else 1e-5  # another order of the same sums
    assert (image[..., :-1] - clean).abs().max() < tolerance and (
        alpha - clean_alpha
    ).abs().max() < tolerance
    *grads, grad_view = torch.autograd.grad(image.sum() + alpha.sum(), leaves)
    assert grad_view.isfinite().all() and grad_view.any()
    for name, grad in zip(NAMES, grads, strict=True):
        assert grad.isfinite().all(), name
        assert not grad[: len(BAD)].any(), name
        assert grad[len(BAD) :].any() or (sh_degree in (None, 0) and name == "quats"), name


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_input_is_drawn_in_float32(dtype):
    scene = splats_in_view(50, 11, scale=-2.5)
    scene[2][::2, 1] = 1e-9  # float16 holds this as zero: the axis is lost, a flat Gaussian is left
    view, K = (t.float()[None] for t in camera_askew())
    half = [t.to(dtype).requires_grad_() for t in scene]
    got, _, meta = rasterization(*half, view.to(dtype).float(), K, 37, 29, sh_degree=3)
    assert got.dtype == torch.float32 and meta["skipped"] == 0
    exact, _, _ = rasterization(
        *[t.detach().float() for t in half], view.to(dtype).float(), K, 37, 29, sh_degree=3
    )
    assert got.any() and torch.equal(got, exact)
    for grad, leaf in zip(torch.autograd.grad(got.mean(), half), half, strict=True):
        assert grad.dtype == leaf.dtype == dtype and grad.isfinite().all() and grad.any()


@pytest.mark.parametrize("absgrad", [False, True])
def test_autocast_changes_neither_image_nor_gradients(absgrad):
    scene = [t.float() for t in splats_in_view(50, 11, scale=-2.5)]
    view, K = (t.float()[None] for t in camera_askew())

    def run(enabled):
        leaves = [t.clone().requires_grad_() for t in (*scene, view)]
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            image, alpha, _ = rasterization(*leaves, K, 37, 29, sh_degree=3, absgrad=absgrad)
            (image.square().sum() + alpha.sum()).backward()
        return [image, alpha, *(leaf.grad for leaf in leaves)]

    for got, want in zip(run(True), run(False), strict=True):
        assert got.dtype == torch.float32 and torch.equal(got, want)


@pytest.mark.parametrize("value", [1e20, 1e30, 1e37, 1e38, 3e38])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_colours_up_to_the_largest_number_have_finite_gradients(value, sh_degree):
    scene = [t.float() for t in splats_in_view(50, 11, scale=-2.5)]
    scene[0][:, :2] *= 0.2  # all in sight
    scene[3] = scene[3].clamp_min(0.1)
    scene[4][:10] = scene[4][:10].sign() * value
    scene[4][:10, 0] = value
    view, K = (t.float()[None] for t in camera_askew())
    leaves = [t.clone().requires_grad_() for t in (*scene, view)]
    image, _, meta = rasterization(*leaves, K, 37, 29, sh_degree=sh_degree)
    assert image.isfinite().all() and (value > 1e31) == (meta["skipped"] > 0)
    for grad in torch.autograd.grad(image.sum(), leaves):
        assert grad.isfinite().all()
