"""Compiled kernels make the colours and draw the images that torch does."""

from unittest import mock

import pytest
import torch

from making import assert_same_on_any_threads, splats_in_view
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.rendering.compiled import blending_kernels as blending
from pointsplat_ns.rendering.spherical_harmonics import sh_to_color
from pointsplat_ns.system.kernels import KERNELS

F32 = torch.float32
F64 = torch.float64
# neither is a multiple of the tile
WIDTH = 70
HEIGHT = 45

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def draw(channels=3, n=3000, cameras=1, focal=50.0, **options):
    """Image, alphas, gradients and absolute gradients of random Gaussians of every opacity, some of
    them opaque; SH coefficients in place of channels where ``sh_degree`` is given."""
    *shape, sh = splats_in_view(n, seed=2, scale=-2.5, opacity=1.3, dtype=F64)
    shape[3].clamp_(max=1.0)
    colors = sh if "sh_degree" in options else torch.cat([sh[:, 0], sh[:, 1]], dim=1)[:, :channels]
    K = torch.tensor([[focal, 0, 33], [0, 52, 21], [0, 0, 1]]).repeat(cameras, 1, 1)
    views = torch.eye(4).repeat(cameras, 1, 1)
    views[:, 0, 3] = 0.3 * torch.arange(cameras)
    leaves = [t.to(F32).requires_grad_() for t in (*shape, colors, views)]
    image, alphas, meta = rasterization(*leaves, K, WIDTH, HEIGHT, absgrad=True, **options)
    slope = torch.linspace(0.2, 1, WIDTH)[None, None, :, None]
    ((image * slope).sin().sum() + (alphas * slope).square().sum()).backward()
    return [image.detach(), alphas.detach(), *(t.grad for t in leaves), meta["means2d"].absgrad]


@needs_compiler
@pytest.mark.parametrize(
    "options",
    [
        *({"channels": channels} for channels in (1, 2, 3, 4)),
        {"render_mode": "RGB+ED"},
        {"cameras": 2},
        {"quality": "fast"},
        {"rasterize_mode": "antialiased"},
        {"memory_budget": 100_000},
        {"n": 3},
        {"focal": -50.0},  # a mirror
        {"near_plane": 2.5, "far_plane": 3.5},
        {"radius_clip": 6.0, "eps2d": 0.1},
    ],
    ids=str,
)
def test_images_and_gradients_are_those_of_torch(options, monkeypatch):
    kernels = mock.Mock(wraps=blending.on_threads)
    monkeypatch.setattr(blending, "on_threads", kernels)
    got = draw(**options, compiled=True)
    assert kernels.call_count >= 3
    kernels.reset_mock()
    wanted = draw(**options, compiled=False)
    assert not kernels.called
    for ours, torchs in zip(got, wanted, strict=True):
        # 2e-5: float32, in another order; a norm, as a pixel at a threshold may fall either way
        assert torchs.any() and (ours - torchs).norm() <= 2e-5 * torchs.norm()


@needs_compiler
def test_any_number_of_threads_draws_the_same_bits():
    assert_same_on_any_threads(
        lambda: draw(
            n=5000, sh_degree=3, rasterize_mode="antialiased", memory_budget=400_000, compiled=True
        )
    )


# Colours


def inputs(stored=17, n=500, m=300):
    """Directions (M, 3) of any length, one of them zero, coefficients (N, K, 3), and rows in no
    order."""
    g = torch.Generator().manual_seed(5)
    directions = torch.randn(m, 3, generator=g) * 10.0 ** torch.linspace(-20, 20, m)[:, None]
    directions[7] = 0
    coefficients = torch.randn(n, stored, 3, generator=g)
    return directions.double(), coefficients.double(), torch.randperm(n, generator=g)[:m]


def colored(directions, coefficients, ids, degree, dtype, compiled):
    """Colours, and the gradients of a fixed sum of them, in float64; those of directions by unit of
    their length."""
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in (directions, coefficients)]
    colors = sh_to_color(leaves[0], leaves[1][:, 0], leaves[1][:, 1:], degree, ids, compiled)
    weights = torch.randn(colors.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
    grads = torch.autograd.grad((colors * weights).sum(), leaves, allow_unused=True)
    of_directions = (
        None if grads[0] is None else grads[0].double() * directions.norm(dim=1, keepdim=True)
    )
    return colors.detach().double(), of_directions, grads[1].double()


@needs_compiler
@pytest.mark.parametrize("extra", [0, 1])
@pytest.mark.parametrize("degree", range(4))
def test_colours_and_gradients_are_those_of_torch_and_as_near_to_float64(degree, extra):
    given = inputs(stored=(degree + 1) ** 2 + extra)
    ours, torchs, exact = (
        colored(*given, degree, *how) for how in ((F32, True), (F32, False), (F64, False))
    )
    assert (ours[0] == 0).any() and (ours[0] > 0).any()
    assert (ours[1] is None) == (torchs[1] is None) == (degree == 0)  # a constant has no direction
    for mine, theirs, right in zip(ours, torchs, exact, strict=True):
        if mine is not None:
            # a colour at 0 may fall on either side, and take its gradient with it: none does here
            assert mine.isfinite().all() and (mine - right).abs().max() <= 2e-6 * right.abs().max()
            assert (mine - right).norm() <= 2 * (theirs - right).norm() + 1e-7 * right.norm()
    rest = torch.ones(len(given[1]), dtype=torch.bool).index_fill_(0, given[2], False)
    assert not ours[2][rest].any() and not ours[2][:, (degree + 1) ** 2 :].any()


@needs_compiler
def test_rows_of_no_gaussian_are_refused_before_memory_is_read():
    directions, coefficients, ids = (t.float() if t.is_floating_point() else t for t in inputs())
    assert sh_to_color(
        directions[:0], coefficients[:, 0], coefficients[:, 1:], 3, ids[:0]
    ).shape == (0, 3)
    for wrong in (-1, len(coefficients)):
        with pytest.raises(
            IndexError, match=f"ids are from .*{wrong}.*expected rows of 500 Gaussians"
        ):
            sh_to_color(
                directions[:2], coefficients[:, 0], coefficients[:, 1:], 3, torch.tensor([3, wrong])
            )
