"""Fill against counts by hand."""

import math

import pytest
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.fill import fill
from pointsplat_ns.views import Views

K = torch.tensor([[[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]]])
VIEWS = Views(torch.eye(4)[None], K, 100, 100, torch.zeros(3))
"""At a depth of 5, a unit is 20 pixels; the picture has 10,000."""


def flat(x: float, stds: tuple[float, float], alpha: float, turn: float = 0.0, copies: int = 1) -> Gaussians:
    """Flat Gaussians that face the camera, at (x, 0, 5); ``turn`` radians about its axis."""
    scene = Gaussians.empty().replace(
        means=torch.tensor([[x, 0.0, 5.0]]),
        scales=torch.tensor([[*stds, 1e-9]]).log(),
        quats=torch.tensor([[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]]),
        opacities=torch.tensor([[alpha]]).logit(),
        features_dc=torch.zeros(1, 3),
        features_rest=torch.zeros(1, 0, 3),
    )
    return scene[torch.zeros(copies, dtype=torch.int64)]


def rectangle(reach: float, stds: tuple[float, float]) -> float:
    """Pixels of a rectangle; 0.3 pixels^2 are added to each variance of the projection."""
    return math.prod(2 * reach * math.sqrt((20 * std) ** 2 + 0.3) for std in stds)


SQUARE, LONG = (0.1, 0.1), (0.4, 0.05)
FAINT = math.sqrt(2 * math.log(255 * 0.02))  # where an opacity of 0.02 falls to 1/255


@pytest.mark.parametrize(
    "scene, pixels",
    [
        (flat(0.0, SQUARE, 0.9), rectangle(math.sqrt(8), SQUARE)),
        (flat(0.0, LONG, 0.9, turn=0.5), rectangle(math.sqrt(8), LONG)),
        (flat(0.0, SQUARE, 0.02), rectangle(FAINT, SQUARE)),
        (flat(0.0, SQUARE, 0.9, copies=3), 3 * rectangle(math.sqrt(8), SQUARE)),
        (flat(-2.5, SQUARE, 0.9), rectangle(math.sqrt(8), SQUARE) / 2),  # its middle is on the edge of the picture
        (flat(0.0, (100.0, 100.0), 0.9), 10_000),  # all of the picture
        (flat(-20.0, SQUARE, 0.9), 0),  # outside
        (flat(0.0, SQUARE, 0.001), 0),  # fainter than 1/255
    ],
)
def test_fill_is_the_area_of_rectangles_over_that_of_the_picture(scene, pixels):
    assert fill(scene, VIEWS) == pytest.approx(pixels / 10_000, rel=1e-4)  # float32


def test_fill_is_the_mean_over_views():
    away = VIEWS.viewmats * torch.tensor([-1.0, 1.0, -1.0, 1.0])[:, None]  # the camera turned back
    both = Views(torch.cat([VIEWS.viewmats, away]), K.repeat(2, 1, 1), 100, 100, torch.zeros(3))
    scene = flat(0.0, SQUARE, 0.9)
    assert fill(scene, both) == pytest.approx(fill(scene, VIEWS) / 2)


def test_of_a_large_scene_some_gaussians_stand_for_all():
    scene = flat(0.0, SQUARE, 0.9, copies=25)
    assert fill(scene, VIEWS, max_count=10) == pytest.approx(fill(scene, VIEWS))
