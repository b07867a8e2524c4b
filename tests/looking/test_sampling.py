"""Sampled cameras."""

import dataclasses
import math

import pytest
import torch
from upright_scenes import TURNS, room, tower, turned

from making import box_room
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking import sampling
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.sampling import Sampler, sample_views
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.rasterizer import pixels_of, render


def places_of(views):
    rotation, translation = views.viewmats[:, :3, :3], views.viewmats[:, :3, 3:]
    return -(rotation.mT @ translation)[..., 0]


def test_sampled_poses_are_rotations_and_show_the_scene(hollow_ball):
    views = sample_views(hollow_ball, 12, 64, 48)
    assert len(views) == 12 and (views.width, views.height) == (64, 48)
    rotation = views.viewmats[:, :3, :3]
    # 1e-12: unit vectors in float64
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(12, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(12).double(), atol=1e-12)
    assert all(render(hollow_ball, views[i]).mean() > 0.02 for i in range(12))


@pytest.mark.parametrize(
    "name, value",
    [("scales", 1e4), ("scales", -1e4), ("opacities", 1e4), ("opacities", -1e4), ("quats", 0.0), ("quats", 3e38),
     ("means", 3e38), ("means", 1e-40), ("features_dc", 3e38), ("features_rest", 3e38)],
)  # fmt: skip
def test_a_few_extreme_gaussians_leave_views_that_are_finite(hollow_ball, name, value):
    scene = hollow_ball.map(lambda tensor: tensor.clone())
    getattr(scene, name)[::20] = value
    views = sample_views(scene, 2, 48, 36)
    assert len(views) == 2 and bool(views.viewmats.isfinite().all())


def test_a_scene_that_shows_nothing_has_no_poses(hollow_ball):
    clear = hollow_ball.replace(opacities=torch.full_like(hollow_ball.opacities, -math.inf))
    for nothing in (clear, hollow_ball[:0], hollow_ball.map(lambda value: value * math.nan)):
        with pytest.raises(DataError, match="nothing of the scene can be seen"):
            sample_views(nothing, 3)
    with pytest.raises(DataError, match="0 views asked for"):
        sample_views(hollow_ball, 0)


def test_looking_straight_up_or_at_oneself_is_a_rotation_too():
    places = torch.zeros(4, 3, dtype=torch.float64)
    targets = torch.tensor([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 0], [1e-30, 0, 1e-30]], dtype=torch.float64)
    rotation = look_at(places, targets)[:, :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(4, 3, 3), atol=1e-12)
    assert torch.allclose(rotation[0] @ targets[0], torch.tensor([0, 0, 1.0]).double(), atol=1e-12)


def test_views_are_upright_and_above_the_floor_for_any_turn_of_the_scene():
    turn = TURNS[1]
    views = sample_views(turned(room(), turn), 8, 64, 48)
    up = torch.from_numpy(turn.apply([0.0, 0.0, 1.0]))
    places = places_of(views) @ torch.from_numpy(turn.as_matrix())  # as in the room before it was turned
    floor = float(room().means[:, 2].min())
    assert float(places[:, 2].min()) > floor
    right, ahead = views.viewmats[:, 0, :3], views.viewmats[:, 2, :3]
    # sines: 3 degrees of error in the estimate of up; no view from straight above
    assert float((right @ up).abs().max()) < 0.05 and float((ahead @ up).abs().max()) < 0.99
    assert float((views.viewmats[:, 1, :3] @ up).max()) < 0  # the image is not upside down


def test_a_room_is_seen_whole_by_a_dozen_views():
    scene = room()
    views = sample_views(scene, 12, 64, 48)
    grey = torch.zeros_like(scene.features_dc, requires_grad=True)
    render(scene.replace(features_dc=grey), views).sum().backward()
    assert float((grey.grad[:, 0] > 0).double().mean()) > 0.95


def test_an_object_is_in_the_middle_and_seen_from_all_sides():
    views = sample_views(tower(), 12, 64, 48)
    places = places_of(views)
    assert float(places[:, 2].min()) > 0  # above the ground
    turns = torch.atan2(places[:, 1], places[:, 0]).sort().values
    gaps = torch.cat([turns[1:], turns[:1] + 2 * math.pi]) - turns
    assert float(gaps.max()) < 0.6 * math.pi
    middle = views.viewmats[:, :3, :3] @ torch.tensor([0.0, 0.0, 1.0]).double() + views.viewmats[:, :3, 3]
    pixels = (views.Ks @ middle[..., None])[..., 0]
    aside = (pixels[:, :2] / pixels[:, 2:] - torch.tensor([32.0, 24.0])).abs() / torch.tensor([32.0, 24.0])
    assert bool((pixels[:, 2] > 0).all()) and float(aside.amax(1).median()) < 0.6


def test_up_can_be_given():
    scene = tower()
    for up in ([1.0, 0.0, 0.0], torch.tensor([0.0, -3.0, 4.0])):
        views = sample_views(scene, 4, 64, 48, up=up)
        up = torch.as_tensor(up).double()
        assert torch.allclose(views.viewmats[:, 0, :3] @ up, torch.zeros(4).double(), atol=1e-12)
    for wrong in ([0.0, 0.0, 0.0], [1.0, 0.0], [math.nan, 0.0, 1.0]):
        with pytest.raises(DataError, match="expected three numbers, not all 0"):
            sample_views(scene, 4, up=wrong)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("make", [room, tower])
def test_views_do_not_depend_on_the_unit_of_length(make, factor):
    scene = make()
    other = scene.replace(means=scene.means * factor, scales=scene.scales + math.log(factor))
    one, two = sample_views(scene, 6, 64, 48, seed=3), sample_views(other, 6, 64, 48, seed=3)
    assert two.near_plane == pytest.approx(one.near_plane * factor, rel=1e-4)
    # 1e-3: float32 positions round otherwise at another scale
    assert torch.allclose(places_of(one) * factor, places_of(two), rtol=1e-3, atol=1e-3 * factor)
    assert torch.allclose(render(scene, one), render(other, two), atol=0.02)


def test_a_view_that_a_few_large_gaussians_fill_is_not_taken(make_hollow_ball):
    """A ball of small Gaussians with a cloud of large ones beside it: nobody takes photos from within a cloud."""
    generator = torch.Generator().manual_seed(5)
    ball = make_hollow_ball(6000)
    ball = ball.replace(scales=ball.scales - 1.5)
    cloud = make_hollow_ball(60)
    middle = ball.means.mean(0) + torch.tensor([6.0, 0.0, 0.0])
    means = middle + 1.5 * torch.randn(60, 3, generator=generator)
    cloud = cloud.replace(means=means, scales=torch.full_like(cloud.scales, -0.3))
    scene = Gaussians(*(torch.cat(pair) for pair in zip(ball.tensors(), cloud.tensors(), strict=True)))
    views = sample_views(scene, 8, 96, 72)
    subtended = []
    for view in views:
        shares = pixels_of(scene, view)
        away = (scene.means.double() - places_of(views).mean(0)).norm(dim=1)
        subtended.append(float((shares * scene.stds.amax(1) / away).sum() / shares.sum()))
    assert len(views) >= 1 and max(subtended) < 0.2


def test_views_of_a_large_scene_are_looked_for_in_a_part_of_it(monkeypatch):
    scene = box_room(0, 3000)
    whole = Sampler(scene).content
    monkeypatch.setattr(sampling, "LOOKING", dataclasses.replace(LOOKING, sampled_count=700))
    few = Sampler(scene, (64, 48))
    assert len(few.scene) == 750 and len(few.views(3)) == 3
    assert few.content[1] == pytest.approx(whole[1], rel=0.05)
