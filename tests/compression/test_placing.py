"""Scenes turned, scaled and brought back to the frame of their data."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.compression.placing import Similarity, run_frame
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.looking.upright import axis_named

SEED = 4


def rotation(seed=SEED):
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return q * torch.linalg.det(q).sign()


def rendered_alike(before, after, similarity):
    """Whether two scenes look the same from cameras that are moved along."""
    views = ps.sample_views(before, 2, width=48, height=36)
    inverse = similarity.inverse()
    viewmats = views.viewmats.clone()
    viewmats[:, :3, :3] = views.viewmats[:, :3, :3] @ inverse.matrix
    # The camera's axes keep their unit, so that depths grow with the scene.
    viewmats[:, :3, 3] = similarity.scale * (views.viewmats[:, :3, :3] @ inverse.offset + views.viewmats[:, :3, 3])
    moved = replace(views, viewmats=viewmats, near_plane=similarity.scale * views.near_plane)
    return float((ps.render(before, views) - ps.render(after, moved)).abs().max())


def test_a_scene_that_is_moved_looks_the_same_from_cameras_that_move_along():
    scene = cloud(300, SEED, 3).to(dtype=torch.float64)
    similarity = Similarity(rotation(), 2.5, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    assert rendered_alike(scene, similarity.apply(scene), similarity) < 1e-4  # the steps of blending are float32


def test_up_is_turned_to_where_it_is_wanted():
    scene = cloud(20, SEED)
    for start, end in (("z", "y"), ("-y", "z"), ("x", "-x"), ("z", "z")):
        turned = ps.place(scene, up=f"{start}:{end}")
        now, wanted = (axis_named(text) for text in (start, end))
        assert torch.allclose(scene.means.double() @ now, turned.means.double() @ wanted, atol=1e-6)


def test_up_is_estimated_where_it_is_not_said():
    room = ps.example_room()[::20]
    turned = ps.place(room, up="z:-y")
    back = ps.place(turned, up="z")
    # Estimated to half a degree; the room is 6 m wide.
    assert float((back.means[:, 2] - room.means[:, 2]).abs().max()) < 0.1


def test_scale_changes_sizes_too():
    scene = cloud(20, SEED)
    larger = ps.place(scene, scale=2.0)
    assert torch.allclose(larger.means, 2 * scene.means) and torch.allclose(larger.scales, scene.scales + math.log(2))


def test_the_frame_of_a_run_is_undone(tmp_path):
    turn = rotation()
    transform = torch.cat([turn, torch.tensor([[0.5], [-0.25], [1.0]])], dim=1).float()
    run = SimpleNamespace(folder=tmp_path, transform=transform, scale=0.125)
    data = cloud(40, SEED)
    scene = run_frame(run).apply(data)  # what nerfstudio does to poses
    expected = 0.125 * (data.means.double() @ transform[:, :3].double().T + transform[:, 3].double())
    assert torch.allclose(scene.means.double(), expected, atol=1e-5)
    assert torch.allclose(run_frame(run).inverse().apply(scene).means, data.means, atol=1e-5)


def test_a_transform_that_is_no_similarity_is_refused(tmp_path):
    run = SimpleNamespace(folder=tmp_path, transform=torch.diag(torch.tensor([1.0, 2.0, 3.0, 1.0]))[:3], scale=1.0)
    with pytest.raises(SceneError, match="not a rotation with one scale"):
        run_frame(run)


@pytest.mark.parametrize("up", ["w", "", "z:", "z:y:x", "north"])
def test_an_axis_that_is_none_is_refused(up):
    with pytest.raises(PointSplatError, match="expected an axis such as z"):
        ps.place(cloud(3), up=up)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_scale_that_means_nothing_is_refused(scale):
    with pytest.raises(PointSplatError, match="expected a number above 0"):
        ps.place(cloud(3), scale=scale)
