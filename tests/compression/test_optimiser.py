"""The loss that is optimised, and the unit in which positions move."""

import pytest
import torch

from making import ball
from pointsplat_ns.compression.optimiser import extent, gradients_of
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.rasterizer import render


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


def test_the_extent_is_the_distance_from_the_median_that_nine_tenths_are_within():
    scene = ball(11)
    distances = torch.arange(11.0)
    scene.means[:] = torch.tensor([3.0, 4.0, 12.0]) / 13 * (distances - distances.mean())[:, None]
    # distances from the median 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5
    assert extent(scene) == pytest.approx(5.0)
    for far in (1e6, 1e30, 3e38):
        scene.means[-1] = far
        assert extent(scene) == pytest.approx(5.0), far
    assert extent(scene[[0] * 4]) == 1.0
