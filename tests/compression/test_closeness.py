"""How close renders come to those of the dense scene."""

import dataclasses
import math

import pytest
import torch

from making import cloud
from pointsplat_ns.compression.closeness import Closeness, DenseReference
from pointsplat_ns.metrics import psnr, ssim
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views

SCENE = cloud(200)


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


def test_empty_margins_bring_nothing_closer():
    narrow = _ahead()
    K = narrow.Ks.clone()
    K[:, 0, 2] += narrow.width
    wide = dataclasses.replace(narrow, Ks=K, width=3 * narrow.width)
    kept = SCENE[:150]
    one, other = DenseReference(SCENE, narrow), DenseReference(SCENE, wide)
    assert 0 < other.covered == pytest.approx(one.covered / 3, rel=1e-6)
    assert other.psnr(kept)[0] == pytest.approx(one.psnr(kept)[0] + 10 * math.log10(3), abs=1e-3)
    (first, second) = (reference.psnr_of_covered(reference.psnr(kept)[0]) for reference in (one, other))
    assert first == pytest.approx(second, abs=1e-3) and first < one.psnr(kept)[0] - 1
    assert one.psnr_of_covered(math.inf) == math.inf


def test_what_is_covered_is_where_the_background_does_not_show():
    views = _ahead()
    white, black = (dataclasses.replace(views, background=torch.full((3,), value)) for value in (1.0, 0.0))
    shows_through = float((render(SCENE, white) - render(SCENE, black)).mean())
    covered = DenseReference(SCENE, views).covered
    assert covered == pytest.approx(1 - shows_through, abs=1e-3) and 0.05 < covered < 0.5
    nothing = DenseReference(SCENE, _ahead(-5.0))  # behind the camera
    assert nothing.covered == 0 and nothing.psnr_of_covered(40.0) == 40.0


def _ahead(distance: float = 5.0) -> Views:
    """A view of all of :data:`SCENE`, a unit cube, from a distance."""
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-0.5, -0.5, distance])
    K = torch.tensor([[96.0, 0.0, 32.0], [0.0, 96.0, 32.0], [0.0, 0.0, 1.0]])
    return Views(viewmat[None], K[None], 64, 64, torch.zeros(3))
