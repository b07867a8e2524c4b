"""The SSIM of the training loss against the one it replaces, and compiled against torch's."""

import math

import pytest
import torch
from pytorch_msssim import SSIM

from making import assert_same_on_any_threads
from pointsplat_ns.metrics import ssim
from pointsplat_ns.metrics.structural_similarity import KERNELS, mean_ssim

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def images(*shape: int, dtype=torch.float64):
    generator = torch.Generator().manual_seed(11)
    image = torch.rand(shape, generator=generator, dtype=dtype)
    return image.requires_grad_(), (0.7 * image.detach() + 0.3 * torch.rand(shape, generator=generator, dtype=dtype))


@pytest.mark.filterwarnings("ignore:Skipping Gaussian Smoothing")
@pytest.mark.parametrize("size", [(40, 33), (11, 11), (12, 5), (4, 30), (3, 3)])
@pytest.mark.parametrize("batch", [1, 3])
def test_value_and_gradient_are_pytorch_msssims(size, batch):
    image, other = images(batch, 3, *size)
    stock = SSIM(data_range=1.0, size_average=True, channel=3)
    value, expected = mean_ssim(image, other), stock(image, other)
    # pytorch-msssim keeps its window in float32: 1e-7 relative on moments of order 1, over C2 = 9e-4 at worst.
    torch.testing.assert_close(value, expected, atol=1e-5, rtol=0)
    (gradient,), (other_gradient,) = (torch.autograd.grad(v, image) for v in (value, expected))
    assert (gradient - other_gradient).abs().max() <= 1e-4 * other_gradient.abs().max()


def test_it_is_the_ssim_that_is_reported():
    image, other = images(1, 3, 40, 33)
    reported = ssim(*(x.detach()[0].permute(1, 2, 0) for x in (image, other)))
    # kornia keeps its window in float32, as above
    torch.testing.assert_close(mean_ssim(image, other).detach(), reported, atol=1e-5, rtol=0)


def test_gradients_agree_with_float64_differences():
    image, other = images(1, 2, 12, 13)
    assert torch.autograd.gradcheck(mean_ssim, (image, other.requires_grad_()))


@pytest.mark.parametrize("compiled", [None, False], ids=["as it is", "torch"])
@pytest.mark.parametrize("level", [0.0, 1e-4, 0.5, 1.0])
def test_flat_images_in_float32_match_float64_in_value_and_gradient(level, compiled):
    noise = 1e-3 * images(1, 3, 20, 20)[1]
    result = {}
    for dtype in (torch.float32, torch.float64):
        image = torch.full((1, 3, 20, 20), level, dtype=dtype).requires_grad_()
        value = mean_ssim(image, (image + noise.to(dtype)).detach(), compiled)
        value.backward()
        result[dtype] = value.detach().double(), image.grad.double()
    # Variances are differences of squares near level^2, so 6e-8 of it is lost, relative to C2 = 9e-4.
    torch.testing.assert_close(result[torch.float32][0], result[torch.float64][0], atol=1e-3, rtol=0)
    assert (result[torch.float32][1] - result[torch.float64][1]).abs().max() < 1e-3


def found(image, other, dtype, compiled, first=True):
    """SSIM of two images, and its gradient by one of them, as float64."""
    leaf = (image if first else other).detach().to(dtype, copy=True).requires_grad_()
    pair = (leaf, other.detach().to(dtype)) if first else (image.detach().to(dtype), leaf)
    value = mean_ssim(*pair, compiled)
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach().double(), gradient.double()


@needs_compiler
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("together", [True, False], ids=["channels together", "planes"])
@pytest.mark.parametrize("shape", [(1, 3, 11, 11), (1, 3, 130, 150), (2, 1, 12, 139), (2, 4, 60, 43), (1, 6, 11, 40)])
def test_compiled_it_is_torchs_and_as_near_to_float64(shape, together, first):
    image, other = images(*shape)
    if together:
        image, other = (x.detach().to(memory_format=torch.channels_last) for x in (image, other))
    ours, torchs = (found(image, other, torch.float32, compiled, first) for compiled in (True, False))
    exact = found(image, other, torch.float64, False, first)
    assert abs(ours[0] - exact[0]) <= 1e-6
    assert (ours[1] - exact[1]).norm() <= 2 * (torchs[1] - exact[1]).norm() + 1e-6 * exact[1].norm()


@needs_compiler
def test_any_number_of_threads_gives_the_same_bits():
    image, other = images(1, 3, 200, 40)
    assert_same_on_any_threads(lambda: found(image, other, torch.float32, True))


@needs_compiler
def test_compiled_a_pixel_that_is_not_finite_spoils_no_gradient_beyond_its_windows():
    image, other = (x.detach() for x in images(1, 3, 40, 300))
    clean = found(image, other, torch.float32, True)[1]
    for wrong in (math.nan, math.inf):
        image[0, 1, 20, 150] = wrong
        value, gradient = found(image, other, torch.float32, True)
        expected = torch.zeros_like(gradient, dtype=torch.bool)
        expected[0, 1, 0:40, 140:161] = True  # 20 rows either way
        assert value.isnan() and gradient[0, 1, 10:31, 140:161].isnan().all()
        assert torch.equal(gradient[~expected], clean[~expected])


def test_gradients_by_both_images_are_torchs():
    image, other = images(1, 3, 20, 20, dtype=torch.float32)
    other = other.detach().requires_grad_()
    both = torch.autograd.grad(mean_ssim(image, other), (image, other))
    assert (both[0] - found(image, other, torch.float32, None)[1]).abs().max() < 1e-6
    assert (both[1] - found(image, other, torch.float32, None, first=False)[1]).abs().max() < 1e-6
