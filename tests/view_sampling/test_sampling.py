"""Sampled cameras: how likely they are, and what they show."""

import math
from dataclasses import replace

import pytest
import torch
from upright_scenes import TURNS, room, tower, turned

from making import ball, box_room, splats
from pointsplat_ns.errors import DataError
from pointsplat_ns.rendering import pixels_of, render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.content import (
    UNITS,
    content_size,
    enlarged,
    in_units,
    views_in_units,
)
from pointsplat_ns.view_sampling.poses import look_at, views_of
from pointsplat_ns.view_sampling.sampler import Sampler, sample_views
from pointsplat_ns.view_sampling.settings import SHIPPED, use_settings
from pointsplat_ns.view_sampling.traces import PhotoTraces
from pointsplat_ns.view_sampling.upright import Up


def places_of(views):
    rotation = views.viewmats[:, :3, :3]
    translation = views.viewmats[:, :3, 3:]
    return -(rotation.mT @ translation)[..., 0]


def test_sampled_poses_are_rotations_and_show_the_scene(hollow_ball):
    views = sample_views(hollow_ball, 12, 64, 48)
    assert len(views) == 12 and (views.width, views.height) == (64, 48)
    rotation = views.viewmats[:, :3, :3]
    # 1e-12: unit vectors in float64
    assert torch.allclose(
        rotation @ rotation.mT, torch.eye(3).double().expand(12, 3, 3), atol=1e-12
    )
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(12).double(), atol=1e-12)
    assert all(render(hollow_ball, views[i]).mean() > 0.02 for i in range(12))


@pytest.mark.parametrize(
    "name, value",
    [
        *(("scales", value) for value in (-1e4, -80.0, 80.0, 1e4)),
        ("opacities", 1e4),
        ("opacities", -1e4),
        ("quats", 0.0),
        ("quats", 3e38),
        ("means", 3e38),
        ("means", 1e-40),
        ("features_dc", 3e38),
        ("features_rest", 3e38),
    ],
)
def test_some_extreme_gaussians_leave_views_and_likelihoods_finite(hollow_ball, name, value):
    scene = hollow_ball.map(lambda tensor: tensor.clone())
    getattr(scene, name)[:: 2 if name == "scales" else 20] = value
    sampler = Sampler(scene, (48, 36))
    views = sampler.views(2)
    assert len(views) == 2 and bool(views.viewmats.isfinite().all())
    assert bool(sampler.judged(views_in_units(views, *sampler.content))[0].isfinite().all())


def test_a_scene_that_shows_nothing_has_no_poses(hollow_ball):
    clear = hollow_ball.replace(opacities=torch.full_like(hollow_ball.opacities, -math.inf))
    for nothing in (clear, hollow_ball[:0], hollow_ball.map(lambda value: value * math.nan)):
        with pytest.raises(DataError, match="nothing of the scene is visible"):
            sample_views(nothing, 3)
    with pytest.raises(DataError, match="cannot sample 0 views"):
        sample_views(hollow_ball, 0)


def test_looking_straight_up_or_at_oneself_is_a_rotation_too():
    places = torch.zeros(4, 3, dtype=torch.float64)
    targets = torch.tensor(
        [[0, 0, 1.0], [0, 0, -1.0], [0, 0, 0], [1e-30, 0, 1e-30]], dtype=torch.float64
    )
    rotation = look_at(places, targets)[:, :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(4, 3, 3), atol=1e-12)
    assert torch.allclose(rotation[0] @ targets[0], torch.tensor([0, 0, 1.0]).double(), atol=1e-12)


def test_views_are_upright_and_above_the_floor_for_any_turn_of_the_scene():
    turn = TURNS[1]
    views = sample_views(turned(room(), turn), 8, 64, 48)
    up = torch.from_numpy(turn.apply([0.0, 0.0, 1.0]))
    places = places_of(views) @ torch.from_numpy(
        turn.as_matrix()
    )  # as in the room before it was turned
    floor = float(room().means[:, 2].min())
    assert float(places[:, 2].min()) > floor
    right = views.viewmats[:, 0, :3]
    ahead = views.viewmats[:, 2, :3]
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
    middle = (
        views.viewmats[:, :3, :3] @ torch.tensor([0.0, 0.0, 1.0]).double()
        + views.viewmats[:, :3, 3]
    )
    pixels = (views.Ks @ middle[..., None])[..., 0]
    aside = (pixels[:, :2] / pixels[:, 2:] - torch.tensor([32.0, 24.0])).abs() / torch.tensor(
        [32.0, 24.0]
    )
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


@pytest.mark.parametrize("factor", [1e-6, 1e6])
@pytest.mark.parametrize("make", [room, tower])
def test_views_do_not_depend_on_the_unit_of_length(make, factor):
    scene = make()
    other = scene.replace(means=scene.means * factor, scales=scene.scales + math.log(factor))
    one = sample_views(scene, 6, 64, 48, seed=3)
    two = sample_views(other, 6, 64, 48, seed=3)
    assert two.near_plane == pytest.approx(one.near_plane * factor, rel=1e-4)
    # 1e-3: float32 positions round otherwise at another scale
    assert torch.allclose(places_of(one) * factor, places_of(two), rtol=1e-3, atol=1e-3 * factor)
    assert torch.allclose(render(scene, one), render(other, two), atol=0.02)


def test_views_of_a_large_scene_are_looked_for_in_a_part_of_it():
    scene = box_room(0, 3000)
    whole = Sampler(scene).content
    with use_settings(replace(SHIPPED, sampled_count=600)):
        few = Sampler(scene, (64, 48))
        given = Sampler(enlarged(scene[::5], 5), (64, 48), stands_for=5)
        assert len(few.scene) == 600 and len(few.views(3)) == 3
        assert torch.equal(few.views(3).viewmats, given.views(3).viewmats)
    assert few.content[1] == pytest.approx(whole[1], rel=0.05)


UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def wall(count: int = 3000, size: float = 0.06) -> Gaussians:
    """A wall of flat Gaussians at y = 0, without SH."""
    at = 8 * torch.rand(count, 2, generator=torch.Generator().manual_seed(3)) - 4
    means = torch.stack([at[:, 0], torch.zeros(count), at[:, 1]], dim=1)
    return splats(means, [math.log(size), math.log(1e-3), math.log(size)], 8.0)


def seen_from(*distances: float) -> Views:
    """Views along y of the origin."""
    eyes = torch.tensor([[0.0, -distance, 0.0] for distance in distances], dtype=torch.float64)
    return views_of(look_at(eyes, torch.zeros_like(eyes), UP), 640, 360, UNITS)


def sampler_of(scene: Gaussians) -> Sampler:
    return Sampler(scene, (640, 360), Up(UP))


def test_the_likelihood_is_that_of_its_formula():
    sampler = sampler_of(wall())
    views = seen_from(2.0, 3.0)
    likelihoods, shown = sampler.judged(views)
    small = replace(views.resized(SHIPPED.candidate_side), rasterize_mode="antialiased")
    width = 0.06 * UNITS / sampler.content[1]
    for row, view in enumerate(small):
        pixels = pixels_of(sampler.few, view).double()
        away = (sampler.few.means.double() - torch.tensor([0.0, -2.0 - row, 0.0])).norm(dim=1)
        blur = float((pixels * width / away).sum() / pixels.sum())
        empty = 1 - float(pixels.sum()) / (view.width * view.height)
        share = (float((pixels > 0.02).sum()) + 1) / 3000
        expected = (
            math.log(share / (empty + 0.01) / blur**2) - 0.5 * (15 / 25) ** 2
        )  # they look level
        assert float(likelihoods[row]) == pytest.approx(expected, abs=1e-4)  # float32
        assert float(shown[row].sum()) + 1 == pytest.approx(share * 3000)


def test_evidence_of_sh_counts_where_there_are_sh():
    scene = ball(500, 1, opacity=5.0)
    views = seen_from(12.0, 15.0)
    without = scene.replace(features_rest=torch.zeros_like(scene.features_rest))
    traces = PhotoTraces(in_units(scene, *content_size(scene)))
    added = sampler_of(scene).judged(views)[0] - sampler_of(without).judged(views)[0]
    torch.testing.assert_close(added, 0.75 * traces.evidence(places_of(views)).double())


def test_the_next_view_shows_what_earlier_ones_do_not():
    shown = torch.zeros(4, 300, dtype=torch.bool)
    shown[0, :150] = shown[1, :149] = True
    shown[2, 150:250] = shown[3, 250:] = True
    likelihoods = torch.tensor([0.0, 0.0, 0.0, -9.0], dtype=torch.float64)
    found = sampler_of(wall(300)).completing
    assert found(likelihoods, shown, 4) == found(likelihoods, shown, 9) == [0, 2, 1, 3]
    assert found(likelihoods, shown, 0) == []
