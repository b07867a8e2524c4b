"""Cameras sampled in free space."""

import math

import pytest
import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.pruning.view_sampling import content_box, look_at, sample_views
from pointsplat_ns.rasterizer import render


def places_of(views):
    rotation, translation = views.viewmats[:, :3, :3], views.viewmats[:, :3, 3:]
    return -(rotation.mT @ translation)[..., 0]


def test_sampled_poses_stand_in_free_space_and_see_the_room(hollow_ball):
    views = sample_views(hollow_ball, 12, 64, 48)
    assert len(views) == 12 and (views.width, views.height) == (64, 48)
    rotation = views.viewmats[:, :3, :3]
    # 1e-12: unit vectors in float64
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(12, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(12).double(), atol=1e-12)
    distance = (places_of(views) - torch.tensor([5.0, 0.0, 0.0])).norm(dim=1)
    assert (distance < 1.95).all()  # inside, not in the blobs of the wall
    assert all(render(hollow_ball, views[i]).mean() > 0.1 for i in range(12))


def test_sampled_poses_are_those_of_their_seed(hollow_ball):
    a, b, c = (sample_views(hollow_ball, 3, seed=seed).viewmats for seed in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_an_object_is_looked_at_from_around_it(make_hollow_ball):
    generator = torch.Generator().manual_seed(3)
    blob = make_hollow_ball(400).replace(means=0.3 * torch.randn(400, 3, generator=generator))
    views = sample_views(blob, 4, 64, 48)
    assert (places_of(views).norm(dim=1) > 0.3).all()
    assert all(render(blob, views[i]).max() > 0.2 for i in range(len(views)))


def test_one_gaussian_is_looked_at(hollow_ball):
    views = sample_views(hollow_ball[5:6], 2, 64, 48)
    assert len(views) >= 1 and render(hollow_ball[5:6], views[0]).max() > 0


def test_a_scene_that_shows_nothing_has_no_poses(hollow_ball):
    clear = hollow_ball.replace(opacities=torch.full_like(hollow_ball.opacities, -math.inf))
    for nothing in (clear, hollow_ball[:0], hollow_ball.map(lambda value: value * math.nan)):
        with pytest.raises(DataError, match="nothing of the scene can be seen"):
            sample_views(nothing, 3)
    with pytest.raises(DataError, match="0 views asked for"):
        sample_views(hollow_ball, 0)


def test_the_box_is_not_moved_by_an_outlier(hollow_ball):
    low, high = content_box(hollow_ball)
    assert torch.allclose(0.5 * (low + high), torch.tensor([5.0, 0.0, 0.0]).double(), atol=0.3)
    assert (high - low < 4.1).all() and (high - low > 3).all()


def test_looking_straight_up_or_at_oneself_is_a_rotation_too():
    places = torch.zeros(4, 3, dtype=torch.float64)
    targets = torch.tensor([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 0], [1e-30, 0, 1e-30]], dtype=torch.float64)
    rotation = look_at(places, targets)[:, :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(4, 3, 3), atol=1e-12)
    assert torch.allclose(rotation[0] @ targets[0], torch.tensor([0, 0, 1.0]).double(), atol=1e-12)
