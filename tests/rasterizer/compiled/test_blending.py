"""Kernels of tiles, colours and blending against torch."""

import pytest
import torch

from making import assert_same_on_any_threads, record_kernels, splats_in_view
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.compiled import blending

WIDTH, HEIGHT = 70, 45  # neither is a multiple of the tile

needs_compiler = pytest.mark.skipif(bool(blending.KERNELS.why_missing), reason=blending.KERNELS.why_missing)


def draw(channels=3, n=3000, dtype=torch.float32, absgrad=True, cameras=1, **options):
    """Image, alphas, gradients and absolute gradients of random Gaussians of every opacity, some of them opaque."""
    *shape, sh = splats_in_view(n, seed=2, scale=-2.5, opacity=1.3, dtype=torch.float64)
    shape[3].clamp_(max=1.0)
    leaves = [t.to(dtype).requires_grad_() for t in (*shape, torch.cat([sh[:, 0], sh[:, 1]], dim=1)[:, :channels])]
    K = torch.tensor([[50.0, 0, 33], [0, 52, 21], [0, 0, 1]], dtype=dtype).repeat(cameras, 1, 1)
    views = torch.eye(4, dtype=dtype).repeat(cameras, 1, 1)
    views[:, 0, 3] = 0.3 * torch.arange(cameras)
    image, alphas, meta = rasterization(*leaves, views, K, WIDTH, HEIGHT, absgrad=absgrad, **options)
    slope = torch.linspace(0.2, 1, WIDTH, dtype=dtype)[None, None, :, None]
    ((image * slope).sin().sum() + (alphas * slope).square().sum()).backward()
    return [image.detach(), alphas.detach(), *(t.grad for t in leaves), meta["means2d"].absgrad]


@pytest.fixture()
def kernel_calls(monkeypatch):
    """The kernels called within the test."""
    return record_kernels(monkeypatch, blending)


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
    ],
    ids=str,
)
def test_images_and_gradients_are_those_of_torch(options, kernel_calls):
    got = draw(**options, compiled=True)
    assert len(kernel_calls) >= 3
    kernel_calls.clear()
    wanted = draw(**options, compiled=False)
    assert not kernel_calls
    for ours, torchs in zip(got, wanted, strict=True):
        # 2e-5: float32, in another order; a norm, as a pixel at a threshold may fall either way
        assert torchs.any() and (ours - torchs).norm() <= 2e-5 * torchs.norm()


@needs_compiler
def test_any_number_of_threads_draws_the_same_bits():
    assert_same_on_any_threads(lambda: draw(memory_budget=400_000))
