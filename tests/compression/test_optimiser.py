"""The loss of a step, and parameters that no step moves."""

import itertools
import math

import pytest
import torch

from making import ball
from pointsplat_ns.compression.optimiser import Adam, AdamSettings, Example, gradients_of, optimised
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.rasterizer import render


def test_steps_leave_infinite_parameters_where_they_are(hollow_ball, ball_views):
    spoiled = hollow_ball[:300].map(torch.clone)
    spoiled.opacities[3], spoiled.opacities[4], spoiled.scales[5, 1] = math.inf, -math.inf, -math.inf
    example = Example(ball_views[0], render(hollow_ball, ball_views[0]))
    steps = optimised(spoiled, Adam(spoiled, AdamSettings()), itertools.repeat(example))
    after = next(itertools.islice(steps, 3, None))
    assert after.opacities[3] == math.inf and after.opacities[4] == -math.inf and after.scales[5, 1] == -math.inf
    assert bool(after.usable().all()) and not torch.equal(after.features_dc, spoiled.features_dc)


@pytest.mark.parametrize(("width", "height"), [(16, 12), (16, SSIM_WINDOW), (16, SSIM_WINDOW - 1)])
def test_the_loss_is_that_of_3dgs_and_without_ssim_where_no_window_fits(width, height):
    scene = ball(40)
    view = sample_views(scene, 1, width, height)[0]
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    leaves = scene.map(lambda value: value.clone().requires_grad_())
    image = render(leaves, view)
    loss = (image - target).abs().mean()
    if height >= SSIM_WINDOW:
        similarity = mean_ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
        loss = 0.8 * loss + 0.2 * (1 - similarity)
    loss.backward()
    found = gradients_of(scene, view, target)
    assert float(found["features_dc"].abs().max()) > 0
    for name, value in leaves.items():
        torch.testing.assert_close(found[name], value.grad, msg=name)
    assert not any(value.requires_grad for value in scene.tensors())
