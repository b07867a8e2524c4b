"""Content, what shows it, and poses."""

import math

import pytest
import torch

from making import ball, box_room, splats
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.content import content_size, in_units, thinned
from pointsplat_ns.view_sampling.sampler import sample_views


def test_content_at_one_position_is_four_standard_deviations_large():
    one = ball(1)
    stacked = Gaussians(*(torch.cat([value, value]) for value in one.tensors()))
    for scene in (one, stacked):
        centre, size = content_size(scene)
        assert size == pytest.approx(4 * float(one.stds.max()))
        torch.testing.assert_close(centre, one.means[0].double())
    for name in ("scales", "opacities"):  # without a size, or invisible
        assert (
            content_size(one.replace(**{name: torch.full_like(getattr(one, name), -math.inf)}))[1]
            == 1.0
        )


def test_a_thinned_scene_covers_as_much():
    room = in_units(box_room(0), *content_size(box_room(0)))
    thin = thinned(room, len(room) // 8)
    view = sample_views(room, 1, 64, 48)[0]
    white = torch.full((3,), 1.0)

    def cover(scene: Gaussians) -> float:
        black = scene.replace(features_dc=torch.full_like(scene.features_dc, -10.0))
        return float(
            1 - render(black, Views(view.viewmat[None], view.K[None], 64, 48, white)[0]).mean()
        )

    assert len(thin) <= len(room) // 8 + len(room) // 64 and cover(thin) > 0.8 * cover(room)


K = torch.tensor([[[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]]])

VIEWS = Views(torch.eye(4)[None], K, 100, 100, torch.zeros(3))
"""At a depth of 5, a unit is 20 pixels; the picture has 10,000."""


def flat(
    x: float, stds: tuple[float, float], alpha: float, turn: float = 0.0, copies: int = 1
) -> Gaussians:
    """Flat Gaussians that face the camera, at (x, 0, 5); ``turn`` radians about its axis."""
    means = torch.tensor([[x, 0.0, 5.0]] * copies)
    quat = [math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]
    return splats(means, torch.tensor([*stds, 1e-9]).log(), torch.tensor(alpha).logit(), quats=quat)


def rectangle(reach: float, stds: tuple[float, float]) -> float:
    """Pixels of a rectangle; 0.3 pixels^2 are added to each variance of the projection."""
    return math.prod(2 * reach * math.sqrt((20 * std) ** 2 + 0.3) for std in stds)


SQUARE = (0.1, 0.1)
LONG = (0.4, 0.05)

FAINT = math.sqrt(2 * math.log(255 * 0.02))  # where an opacity of 0.02 falls to 1/255


@pytest.mark.parametrize(
    "scene, pixels",
    [
        (flat(0.0, SQUARE, 0.9), rectangle(math.sqrt(8), SQUARE)),
        (flat(0.0, LONG, 0.9, turn=0.5), rectangle(math.sqrt(8), LONG)),
        (flat(0.0, SQUARE, 0.02), rectangle(FAINT, SQUARE)),
        (flat(0.0, SQUARE, 0.9, copies=3), 3 * rectangle(math.sqrt(8), SQUARE)),
        (
            flat(-2.5, SQUARE, 0.9),
            rectangle(math.sqrt(8), SQUARE) / 2,
        ),  # its middle is on the edge of the picture
        (flat(0.0, (100.0, 100.0), 0.9), 10_000),  # all of the picture
        (flat(-20.0, SQUARE, 0.9), 0),  # outside
        (flat(0.0, SQUARE, 0.001), 0),  # fainter than 1/255
    ],
)
def test_fill_is_the_area_of_rectangles_over_that_of_the_picture(scene, pixels):
    assert fill(scene, VIEWS) == pytest.approx(pixels / 10_000, rel=1e-4)  # float32
