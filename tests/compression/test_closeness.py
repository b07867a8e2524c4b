"""How close renders come to those of the dense scene."""

import math

import pytest
import torch

from pointsplat_ns.compression.closeness import Closeness, DenseReference
from pointsplat_ns.metrics import psnr, ssim
from pointsplat_ns.rasterizer import render


def test_closeness_is_that_of_the_metrics_over_all_views(hollow_ball, ball_views):
    reference, kept, shares = DenseReference(hollow_ball, ball_views), hollow_ball[:900], []
    close = reference.closeness(kept, shares.append)
    pictures = torch.stack([render(kept, ball_views[i]) for i in range(4)]).double()
    wanted = torch.stack(reference.renders).double()
    each = psnr(pictures, wanted)
    # 1e-6: float64 means, summed in another order
    assert close.psnr == pytest.approx(float(-10 * torch.log10((pictures - wanted).square().mean())), abs=1e-6)
    assert close.worst == pytest.approx(float(each.min()), abs=1e-6) and close.worst < close.psnr
    assert close.ssim == pytest.approx(float(ssim(pictures, wanted).mean()), abs=1e-5)  # float32 there
    assert reference.psnr(kept) == (close.psnr, close.worst) and shares == [0.25, 0.5, 0.75, 1.0]
    itself = reference.closeness(hollow_ball)
    assert itself.psnr == itself.worst == math.inf and itself.ssim == pytest.approx(1.0)
    assert DenseReference(hollow_ball, ball_views.resized(10)).closeness(kept).ssim is None


def test_an_error_that_is_no_number_is_no_perfect_score():
    spoiled = Closeness((1e-3, math.nan), None)
    assert math.isnan(spoiled.psnr) and not spoiled.psnr > Closeness((0.5,), None).psnr
    assert Closeness((1e-300,), None).psnr == pytest.approx(3000) and Closeness((0.0,), None).psnr == math.inf
