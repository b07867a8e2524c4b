"""Coverage: the share of the visible content that views show."""

import torch

from making import ball
from pointsplat_ns.looking.coverage import coverage
from pointsplat_ns.looking.sampling import sample_views


def test_views_all_around_show_nearly_all_and_one_side_less():
    scene = ball(600)
    around = sample_views(scene, 24, 64, 48)
    one_side = around[[0, 0, 0]]
    assert coverage(scene, around) > 0.9
    assert 0.05 < coverage(scene, one_side) < 0.75


def test_one_view_shows_nothing_twice():
    scene = ball(600)
    views = sample_views(scene, 1, 64, 48)
    assert coverage(scene, views) == 0.0 and coverage(scene, views, times=1) > 0.05


def test_a_scene_that_is_not_visible_has_coverage_zero():
    scene = ball(50)
    views = sample_views(scene, 2, 64, 48)
    assert coverage(scene.replace(opacities=torch.full_like(scene.opacities, -30.0)), views) == 0.0
