"""The SSIM of the training loss against the one it replaces."""

from __future__ import annotations

import pytest
import torch
from pytorch_msssim import SSIM

from pointsplat_ns.metrics import ssim
from pointsplat_ns.metrics.structural_similarity import mean_ssim


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


@pytest.mark.parametrize("level", [0.0, 1e-4, 0.5, 1.0])
def test_flat_images_in_float32_match_float64_in_value_and_gradient(level):
    noise = 1e-3 * images(1, 3, 20, 20)[1]
    result = {}
    for dtype in (torch.float32, torch.float64):
        image = torch.full((1, 3, 20, 20), level, dtype=dtype).requires_grad_()
        value = mean_ssim(image, (image + noise.to(dtype)).detach())
        value.backward()
        result[dtype] = value.detach().double(), image.grad.double()
    # Variances are differences of squares near level^2, so 6e-8 of it is lost, relative to C2 = 9e-4.
    torch.testing.assert_close(result[torch.float32][0], result[torch.float64][0], atol=1e-3, rtol=0)
    assert (result[torch.float32][1] - result[torch.float64][1]).abs().max() < 1e-3


def test_identical_images_give_1():
    image, _ = images(1, 3, 16, 16)
    assert mean_ssim(image, image.detach()).item() == pytest.approx(1.0, abs=1e-12)
