"""PSNR and SSIM against what other projects report, and at the extremes."""

import math

import pytest
import torch

from making import noisy_pair as pair
from pointsplat_ns.metrics import ImageError, psnr, psnr_of, ssim


def test_psnr_of_a_known_error():
    target = torch.full((8, 8, 3), 0.5, dtype=torch.float64)
    for decibels in (10.0, 20.0, 30.0):
        assert float(psnr(target + 10 ** (-decibels / 20), target)) == pytest.approx(decibels, abs=1e-9)


def test_psnr_of_identical_images_is_infinite():
    assert float(psnr(*[torch.rand(4, 4, 3)] * 2)) == math.inf


@pytest.mark.parametrize("covered", [1.0, 0.25, 1e-300])
@pytest.mark.parametrize("error", [5e-324, 1e-12, 1e-4, 1.0, 1e6, 1e300])
def test_psnr_of_covered_pixels_at_all_extremes(error, covered):
    assert psnr_of(error, covered) == pytest.approx(-10 * (math.log10(error) - math.log10(covered)))
    assert psnr_of(0.0, covered) == psnr_of(0.0, 0.0) == math.inf and psnr_of(error, 0.0) == psnr_of(error)
    assert math.isnan(psnr_of(math.nan, covered))


def test_psnr_is_torchmetrics():
    torchmetrics = pytest.importorskip("torchmetrics.functional.image")
    a, b = pair(20, 30)
    # 1e-4 dB: float32 sums in another order
    assert float(psnr(a, b)) == pytest.approx(
        float(torchmetrics.peak_signal_noise_ratio(a, b, data_range=1.0)), abs=1e-4
    )


@pytest.mark.parametrize("shape", [(11, 11), (24, 37)])
def test_ssim_is_torchmetrics_away_from_the_border(shape):
    torchmetrics = pytest.importorskip("torchmetrics.functional.image")
    a, b = pair(2, *shape, dtype=torch.float64)
    nchw = (x.permute(0, 3, 1, 2) for x in (a, b))
    _, full = torchmetrics.structural_similarity_index_measure(
        *nchw, data_range=1.0, reduction="none", return_full_image=True
    )
    expected = full[:, :, 5:-5, 5:-5].mean(dim=(1, 2, 3))  # torchmetrics also averages a reflected border of 5
    assert torch.allclose(ssim(a, b), expected, atol=1e-6)  # windows summed in another order


def test_ssim_in_float32_is_ssim_in_float64_on_dark_bright_and_striped_images():
    a, b = pair(24, 24, dtype=torch.float64)
    stripes = (torch.arange(24) % 2).double()[:, None, None].expand(24, 24, 3)
    for x, y in ((a, b), (1e-3 * a, 1e-3 * b), (1 - 1e-3 * a, 1 - 1e-3 * b), (stripes, 1 - stripes)):
        assert float(ssim(x.float(), y.float())) == pytest.approx(float(ssim(x, y)), abs=1e-3)  # as above


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_a_batch_gives_one_value_an_image(metric):
    a, b = pair(3, 16, 20)
    values = metric(a, b)
    assert values.shape == (3,)
    for i in range(3):
        assert metric(a[i], b[i]).shape == ()
        assert float(values[i]) == pytest.approx(float(metric(a[i], b[i])), rel=1e-5)  # float32 sums


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_gradients_agree_with_float64_differences(metric):
    a, b = pair(12, 13, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: metric(x, b), a.requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (torch.rand(3, 20, 20), torch.rand(3, 20, 20), r"pred has shape \(3, 20, 20\); expected \(H, W, 3\)"),
        (torch.rand(20, 20, 3), torch.rand(20, 21, 3), r"pred has shape \(20, 20, 3\) but target \(20, 21, 3\)"),
        (torch.rand(20, 20, 3), torch.rand(20, 20), "target has shape"),
        (torch.zeros(0, 20, 20, 3), torch.zeros(0, 20, 20, 3), "pred has shape"),
        (torch.zeros(20, 20, 3, dtype=torch.uint8), torch.zeros(20, 20, 3), "pred is torch.uint8"),
    ],
)
def test_images_that_cannot_be_compared_are_said(metric, a, b, message):
    with pytest.raises(ImageError, match=message):
        metric(a, b)


def test_images_below_the_window_are_said():
    with pytest.raises(
        ImageError, match="images of 20 x 10 pixels are smaller than SSIM's window; expected at least 11 x 11"
    ):
        ssim(torch.rand(10, 20, 3), torch.rand(10, 20, 3))
