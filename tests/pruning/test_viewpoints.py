"""Where a scene is looked at from, and how large things are from there."""

from __future__ import annotations

import math

import pytest
import torch

from making import ball, box_room
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, content_size, in_units, thinned
from pointsplat_ns.pruning.viewpoints import EDGE, NOT_SHOWN, in_picture, viewpoints, weights_seen
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views


def at(*eyes: tuple[float, float, float]) -> Views:
    """Views from some places, along z."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(eyes), 1, 1)
    viewmats[:, :3, 3] = -torch.tensor(eyes, dtype=torch.float64)
    K = torch.tensor([[10.0, 0, 8], [0, 10.0, 8], [0, 0, 1.0]]).repeat(len(eyes), 1, 1)
    return Views(viewmats, K, 16, 16, torch.zeros(3))


def test_weights_fall_with_the_square_of_the_distance():
    means = torch.tensor([[0.0, 0, 50.0], [0.0, 0, 100.0]], dtype=torch.float64)
    near, far = weights_seen(means, at((0, 0, 0))).tolist()
    assert near / far == pytest.approx(4, rel=0.01)  # the nearest distance adds in quadrature


def test_weights_are_the_mean_over_places_and_finite_at_the_eye_itself():
    means = torch.zeros(1, 3, dtype=torch.float64)
    one, two = weights_seen(means, at((0, 0, 0))), weights_seen(means, at((0, 0, 0), (1e9, 0, 0)))
    assert bool(one.isfinite().all()) and float(two / one) == pytest.approx(0.5)


def test_positions_at_the_end_of_the_range_have_a_weight_of_zero_or_more():
    weights = weights_seen(torch.full((1, 3), 1e300, dtype=torch.float64), at((0, 0, 0)))
    assert float(weights) == 0.0


def test_what_is_in_a_picture_is_in_front_and_inside_of_its_edges():
    """Focal length 10 and 16 pixels: the edge is at 0.8 of the depth."""
    edge = 0.8 * (1 + 2 * EDGE)
    x = torch.tensor([0.0, 0.0, 0.0, 0.99 * edge, 1.01 * edge, -0.99 * edge, -1.01 * edge, 0.0], dtype=torch.float64)
    z = torch.tensor([1.0, -1.0, 0.0, 1, 1, 1, 1, 1e300], dtype=torch.float64)
    for places in (torch.stack([x, 0 * x, z], 1), torch.stack([0 * x, x, z], 1)):
        assert in_picture(places, at((0, 0, 0))[0]).tolist() == [True, False, False, True, False, True, False, True]


def test_what_no_view_shows_counts_for_next_to_nothing_if_where_they_look_matters():
    means = torch.tensor([[0.0, 0, 50.0], [0.0, 0, -50.0]], dtype=torch.float64)
    views = at((0, 0, 0), (0, 1, 0))
    ahead, behind = weights_seen(means, views, NOT_SHOWN).tolist()
    assert behind == pytest.approx(NOT_SHOWN * ahead, rel=1e-3)
    assert weights_seen(means, views).tolist() == pytest.approx([ahead, ahead], rel=1e-3)


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
def test_in_units_all_sizes_are_alike(factor):
    room = box_room(0)
    room = room.replace(means=room.means * factor, scales=room.scales + math.log(factor))
    normal = in_units(room, *content_size(room))
    centre, size = content_size(normal)
    assert size == pytest.approx(UNITS, rel=1e-3) and float(centre.abs().max()) < 1e-3 * UNITS


def test_the_size_of_a_point_is_that_of_its_gaussian_and_of_nothing_one():
    one = ball(1)
    assert content_size(one)[1] == pytest.approx(float(one.stds.max()))
    assert content_size(one.replace(scales=torch.full((1, 3), -math.inf)))[1] == 1.0
    assert content_size(one.replace(opacities=torch.full((1, 1), -math.inf)))[1] == 1.0


def test_a_thinned_scene_covers_as_much():
    room = in_units(box_room(0), *content_size(box_room(0)))
    thin = thinned(room, len(room) // 8)
    view = viewpoints(room, None, 64, 48)[0]
    white = torch.full((3,), 1.0)

    def cover(scene: Gaussians) -> float:
        black = scene.replace(features_dc=torch.full_like(scene.features_dc, -10.0))
        return float(1 - render(black, Views(view.viewmat[None], view.K[None], 64, 48, white)[0]).mean())

    assert len(thin) <= len(room) // 8 + len(room) // 64 and cover(thin) > 0.8 * cover(room)


def test_without_a_free_place_there_are_no_views():
    fog = ball(200)
    assert viewpoints(fog.replace(opacities=torch.full((200, 1), -math.inf)), None, 32, 24) is None
