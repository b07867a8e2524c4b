"""The check of poses against a scene: right poses pass, those of wrong frames do not."""

import math
from dataclasses import replace

import pytest
import torch

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.pipeline.photos.pose_check import likeness, pose_faults
from pointsplat_ns.scene.rotation import Similarity

pytestmark = pytest.mark.usefixtures("quick")


def statue(count: int = 3000, scale: float = 1.0) -> ps.Gaussians:
    """An object on an empty background, of small Gaussians on a ball, with three large floaters
    around."""
    scene = ball(count, log_size=math.log(0.05), opacity=4.0)
    some = scene[:3].replace(means=scene.means[:3] * 2.2, scales=scene.scales[:3] + math.log(30.0))
    every = ps.Gaussians(
        *(torch.cat(pair) for pair in zip(scene.tensors(), some.tensors(), strict=True))
    )
    return Similarity(
        torch.eye(3, dtype=torch.float64), scale, torch.zeros(3, dtype=torch.float64)
    ).apply(every)


def around(distance: float, count: int = 12, focal: float = 600.0) -> ps.Views:
    """Cameras on a circle that look at the origin."""
    from pointsplat_ns.view_sampling.poses import look_at

    turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    eyes = distance * torch.stack([turns.cos(), turns.sin(), torch.full_like(turns, 0.3)], dim=1)
    K = torch.tensor([[focal, 0.0, 320.0], [0.0, focal, 240.0], [0.0, 0.0, 1.0]]).repeat(
        count, 1, 1
    )
    return ps.Views(look_at(eyes, torch.zeros_like(eyes)), K, 640, 480, torch.zeros(3))


def moved(views: ps.Views, change) -> ps.Views:
    return replace(views, viewmats=invert_rigid(change(invert_rigid(views.viewmats))))


def flipped(poses: torch.Tensor) -> torch.Tensor:
    return poses * poses.new_tensor([1.0, -1.0, -1.0, 1.0])


def farther(poses: torch.Tensor) -> torch.Tensor:
    return poses * poses.new_tensor([1.0, 1.0, 1.0, 50.0])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("count", [2, 12])
def test_views_around_an_object_pass_at_any_scale_and_number(scale, count):
    views = around(8.0 * scale, count)
    faults = pose_faults(statue(scale=scale), replace(views, near_plane=0.01 * scale))
    assert (faults.checked, faults.serious) == (min(count, 8), False)


@pytest.mark.parametrize("wrong", [flipped, invert_rigid, farther])
def test_cameras_that_look_past_the_scene_are_told(wrong):
    faults = pose_faults(statue(), moved(around(8.0), wrong))
    assert (
        str(faults).startswith(f"{8 - faults.empty} of 8 cameras see anything of the scene")
        and faults.empty > 4
    )


def test_cameras_that_stand_in_large_gaussians_are_told():
    scene = statue()

    def into_floater(poses: torch.Tensor) -> torch.Tensor:
        poses = poses.clone()
        poses[:, :3, 3] = scene.means[-1] + 0.1 * poses[:, :3, 3]
        return poses

    faults = pose_faults(scene, moved(around(8.0), into_floater))
    assert (
        str(faults).endswith(f", {faults.smeared} of them nothing but a blur")
        and faults.smeared > 4
    )


def test_small_objects_and_few_large_gaussians_pass_in_their_views():
    assert not pose_faults(statue(), around(16.0, focal=300.0)).serious, "a fiftieth of the picture"
    scene = ball(500)
    assert not pose_faults(scene, ps.sample_views(scene, 8, 64, 48)).serious


def test_half_of_the_views_may_look_elsewhere():
    views = around(8.0, 8)
    turned = replace(
        views, viewmats=torch.cat([views.viewmats[:4], moved(views, flipped).viewmats[4:]])
    )
    assert not pose_faults(statue(), turned).serious
    turned = replace(
        views, viewmats=torch.cat([views.viewmats[:3], moved(views, flipped).viewmats[3:]])
    )
    assert str(pose_faults(statue(), turned)).startswith("3 of 8 cameras see anything")


@pytest.mark.parametrize("rows", [0, 5])
def test_a_scene_that_shows_nothing_and_no_view_have_no_fault(rows):
    scene = statue()
    faint = scene[:rows].replace(opacities=scene.opacities[:rows] * 0 - 30)
    assert not pose_faults(faint, around(8.0)).serious
    assert not pose_faults(scene, around(8.0)[:0]).serious
    assert likeness(scene, []).enough


@pytest.mark.parametrize("size", [-200.0, 200.0, math.nan])
def test_sizes_at_their_extremes_give_an_answer(size):
    scene = statue()
    scales = scene.scales.clone()
    scales[:10] = size
    assert pose_faults(scene.replace(scales=scales), around(8.0)).checked == 8


def photos_of(scene: ps.Gaussians, views: ps.Views) -> list:
    return [(view, ps.render(scene, view), None) for view in views]


def test_photos_of_other_exposure_opacity_and_size_are_like_their_renders():
    scene = statue()
    views = around(8.0, 5)
    photos = [
        (view, (255 * (0.3 * photo + 0.5)).to(torch.uint8), mask)
        for view, photo, mask in photos_of(scene, views)
    ]
    faint = scene.replace(opacities=scene.opacities - 5.0)
    found = likeness(faint, photos)
    assert found.enough and found.own > 0.5 and found.count == 5 and found.psnr < 15


def test_photos_of_views_a_turn_away_are_not_like_their_renders():
    scene = statue()
    views = around(8.0)
    photos = photos_of(scene, views)
    other = [
        (views[(index + 6) % 12], photo, mask) for index, (_, photo, mask) in enumerate(photos)
    ]
    background = [
        (view, torch.rand(480, 640, 3, generator=torch.Generator().manual_seed(3)), None)
        for view in views
    ]
    assert likeness(scene, photos).enough
    assert "dB PSNR in 12 photos, correlation" in str(likeness(scene, background))
    assert likeness(scene, other).own < likeness(scene, photos).own - 0.3


def test_masked_pixels_do_not_count():
    scene = statue()
    views = around(8.0, 4)
    mask = torch.zeros(480, 640, 1, dtype=torch.bool)
    mask[:, :320] = True
    spoilt = [
        (view, torch.where(mask, photo, 1 - photo), mask)
        for view, photo, _ in photos_of(scene, views)
    ]
    assert likeness(scene, spoilt).own > 0.98
    assert likeness(scene, [(view, photo, None) for view, photo, _ in spoilt]).own < 0.9
