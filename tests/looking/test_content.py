"""The content of a scene: its place and size, and fewer Gaussians that cover as much."""

import math

import pytest
import torch

from making import ball, box_room
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, content_box, content_size, in_units, thinned
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
def test_in_units_all_sizes_are_alike(factor):
    room = box_room(0)
    room = room.replace(means=room.means * factor, scales=room.scales + math.log(factor))
    normal = in_units(room, *content_size(room))
    centre, size = content_size(normal)
    assert size == pytest.approx(UNITS, rel=1e-3) and float(centre.abs().max()) < 1e-3 * UNITS


def test_content_at_one_position_is_four_standard_deviations_large():
    one = ball(1)
    stacked = Gaussians(*(torch.cat([value, value]) for value in one.tensors()))
    for scene in (one, stacked):
        centre, size = content_size(scene)
        assert size == pytest.approx(4 * float(one.stds.max()))
        torch.testing.assert_close(centre, one.means[0].double())


@pytest.mark.parametrize("name", ["scales", "opacities"])
def test_content_without_a_size_or_that_is_not_visible_has_size_one(name):
    one = ball(1)
    assert content_size(one.replace(**{name: torch.full_like(getattr(one, name), -math.inf)}))[1] == 1.0


def test_the_box_of_content_that_is_not_visible_is_an_error():
    with pytest.raises(DataError, match="nothing of the scene can be seen"):
        content_box(ball(3, opacity=-math.inf))


def test_a_thinned_scene_covers_as_much():
    room = in_units(box_room(0), *content_size(box_room(0)))
    thin = thinned(room, len(room) // 8)
    view = sample_views(room, 1, 64, 48)[0]
    white = torch.full((3,), 1.0)

    def cover(scene: Gaussians) -> float:
        black = scene.replace(features_dc=torch.full_like(scene.features_dc, -10.0))
        return float(1 - render(black, Views(view.viewmat[None], view.K[None], 64, 48, white)[0]).mean())

    assert len(thin) <= len(room) // 8 + len(room) // 64 and cover(thin) > 0.8 * cover(room)
