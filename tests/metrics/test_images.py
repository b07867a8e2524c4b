"""PSNR and structural similarity."""

import math

import pytest
import torch
from pytorch_msssim import SSIM

from making import noisy_pair as pair
from pointsplat_ns.metrics import PIXEL_LOSSES, ImageError, l1_loss, psnr, psnr_of, rmse_loss, ssim
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.system.kernels import KERNELS
from pointsplat_ns.system.threads import fixed_threads


def test_psnr_of_a_known_error():
    target = torch.full((8, 8, 3), 0.5, dtype=torch.float64)
    for decibels in (10.0, 20.0, 30.0):
        assert float(psnr(target + 10 ** (-decibels / 20), target)) == pytest.approx(
            decibels, abs=1e-9
        )


@pytest.mark.parametrize("covered", [1.0, 0.25, 1e-300])
@pytest.mark.parametrize("error", [5e-324, 1e-12, 1e-4, 1.0, 1e6, 1e300])
def test_psnr_of_covered_pixels_at_all_extremes(error, covered):
    assert psnr_of(error, covered) == pytest.approx(-10 * (math.log10(error) - math.log10(covered)))
    assert psnr_of(0.0, covered) == psnr_of(0.0, 0.0) == math.inf and psnr_of(
        error, 0.0
    ) == psnr_of(error)
    assert math.isnan(psnr_of(math.nan, covered))


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_gradients_agree_with_float64_differences(metric):
    a, b = pair(12, 13, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        metric, (a.requires_grad_(), b.requires_grad_()), fast_mode=True
    )


def test_the_gradient_of_psnr_of_a_batch_is_that_of_each_image_alone():
    a, b = (image.requires_grad_() for image in pair(3, 5, 7, dtype=torch.float64))
    assert torch.autograd.gradcheck(psnr, (a, b))
    together = torch.autograd.grad(psnr(a, b).sum(), a)[0]
    alone = torch.stack([torch.autograd.grad(psnr(x, y), x)[0] for x, y in zip(a, b, strict=True)])
    assert torch.equal(together, alone)


@pytest.mark.parametrize("error", [1e-150, 1e-12, 1e-4, 1.0, 1e6, 1e150])
def test_gradients_of_psnr_are_those_of_its_formula_at_all_extremes(error):
    """-20 / ln 10 times the difference, divided by the sum of its squares."""
    difference = error * torch.tensor([[[1.0, -0.5, 0.25], [0.0, 0.75, -1.0]]]).double()
    a = difference.clone().requires_grad_()
    b = torch.zeros_like(difference, requires_grad=True)
    psnr(a, b).backward()
    unit = difference / error
    expected = -20 / math.log(10) * unit / unit.square().sum()
    # 1e-12: some roundings of float64
    assert torch.allclose(a.grad * error, expected, rtol=1e-12, atol=0)
    assert torch.equal(b.grad, -a.grad)


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (
            torch.rand(3, 20, 20),
            torch.rand(3, 20, 20),
            r"pred has shape \(3, 20, 20\); expected \(H, W, 3\)",
        ),
        (
            torch.rand(20, 20, 3),
            torch.rand(20, 21, 3),
            r"pred has shape \(20, 20, 3\) but target \(20, 21, 3\)",
        ),
        (torch.rand(20, 20, 3), torch.rand(20, 20), "target has shape"),
        (torch.zeros(0, 20, 20, 3), torch.zeros(0, 20, 20, 3), "pred has shape"),
        (torch.zeros(20, 20, 3, dtype=torch.uint8), torch.zeros(20, 20, 3), "pred is torch.uint8"),
    ],
)
def test_images_that_cannot_be_compared_are_said(metric, a, b, message):
    with pytest.raises(ImageError, match=message):
        metric(a, b)


needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def images(*shape: int, dtype=torch.float64):
    generator = torch.Generator().manual_seed(11)
    image = torch.rand(shape, generator=generator, dtype=dtype)
    return image.requires_grad_(), (
        0.7 * image.detach() + 0.3 * torch.rand(shape, generator=generator, dtype=dtype)
    )


@pytest.mark.filterwarnings("ignore:Skipping Gaussian Smoothing")
@pytest.mark.parametrize("size", [(40, 33), (11, 11), (12, 5), (4, 30), (3, 3)])
@pytest.mark.parametrize("batch", [1, 3])
def test_value_and_gradient_are_pytorch_msssims(size, batch):
    image, other = images(batch, 3, *size)
    stock = SSIM(data_range=1.0, size_average=True, channel=3)
    value = mean_ssim(image, other)
    expected = stock(image, other)
    # pytorch-msssim keeps its window in float32: 1e-7 relative on moments of order 1, over C2 =
    # 9e-4 at worst.
    torch.testing.assert_close(value, expected, atol=1e-5, rtol=0)
    if min(size) >= 11:
        torch.testing.assert_close(
            ssim(*(x.permute(0, 2, 3, 1) for x in (image, other))).mean(), value
        )
    (gradient,), (other_gradient,) = (torch.autograd.grad(v, image) for v in (value, expected))
    assert (gradient - other_gradient).abs().max() <= 1e-4 * other_gradient.abs().max()


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
    # Variances are differences of squares near level^2, so 6e-8 of it is lost, relative to C2 =
    # 9e-4.
    torch.testing.assert_close(
        result[torch.float32][0], result[torch.float64][0], atol=1e-3, rtol=0
    )
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
@pytest.mark.parametrize(
    "shape", [(1, 3, 11, 11), (1, 3, 130, 150), (2, 1, 12, 139), (2, 4, 60, 43), (1, 6, 11, 40)]
)
def test_compiled_it_is_torchs_and_as_near_to_float64(shape, together, first):
    image, other = images(*shape)
    if together:
        image, other = (x.detach().to(memory_format=torch.channels_last) for x in (image, other))
    ours, torchs = (
        found(image, other, torch.float32, compiled, first) for compiled in (True, False)
    )
    exact = found(image, other, torch.float64, False, first)
    assert abs(ours[0] - exact[0]) <= 1e-6
    assert (ours[1] - exact[1]).norm() <= 2 * (torchs[1] - exact[1]).norm() + 1e-6 * exact[1].norm()


@needs_compiler
def test_a_pixel_that_is_not_finite_spoils_only_its_windows():
    image, other = (x.detach() for x in images(1, 3, 40, 300))
    clean = found(image, other, torch.float32, True)[1]
    for wrong in (math.nan, math.inf):
        image[0, 1, 20, 150] = wrong
        value, gradient = found(image, other, torch.float32, True)
        expected = torch.zeros_like(gradient, dtype=torch.bool)
        expected[0, 1, 0:40, 140:161] = True  # 20 rows either way
        assert value.isnan() and gradient[0, 1, 10:31, 140:161].isnan().all()
        assert torch.equal(gradient[~expected], clean[~expected])


def test_images_below_the_window_are_said():
    with pytest.raises(
        ImageError, match="20 x 10 pixels are smaller than SSIM's window; expected at least 11 x 11"
    ):
        ssim(torch.rand(10, 20, 3), torch.rand(10, 20, 3))


def test_losses_of_large_pictures_have_the_same_gradients_on_any_number_of_threads():
    for seed in range(6):  # sums of some of them are rounded in other ways by two or three threads
        found = []
        for count in (1, 2, 3):
            difference = (
                torch.rand(360, 640, 3, generator=torch.Generator().manual_seed(seed))
                .sub(0.5)
                .requires_grad_()
            )
            with fixed_threads(count):
                sum(loss(difference) for loss in PIXEL_LOSSES.values()).backward()
            found.append(difference.grad)
        assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


@pytest.mark.parametrize("shape", [(6, 5, 3), (2, 6, 5, 3)])
def test_losses_are_means_over_all_pixels_and_check_shapes(shape):
    generator = torch.Generator().manual_seed(3)
    a, b = torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    assert l1_loss(a, b).item() == pytest.approx(torch.nn.functional.l1_loss(a, b).item())
    squared = torch.nn.functional.mse_loss(a, b).item()
    assert rmse_loss(a, b).item() == pytest.approx(math.sqrt(squared), rel=1e-9)
    for loss in (l1_loss, rmse_loss):
        with pytest.raises(ImageError, match="expected the same"):
            loss(a, b[..., :3, :])


def test_the_gradient_of_rmse_is_finite_for_identical_images():
    image = torch.full((4, 4, 3), 0.5, requires_grad=True)
    rmse_loss(image, image.detach()).backward()
    assert image.grad.isfinite().all()
