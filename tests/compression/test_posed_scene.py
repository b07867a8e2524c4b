"""Scenes in their photos' coordinates."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import pointsplat_ns as ps
from making import ball, cloud, run_of
from pointsplat_ns.cli import main
from pointsplat_ns.compression.placing import run_frame
from pointsplat_ns.compression.posed_scene import check_views_show, read_posed
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.io.turning import Similarity
from pointsplat_ns.looking.upright import axis_named
from posing import inria, nerfstudio, written


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return ball(500)


@pytest.fixture(scope="module")
def views(scene) -> ps.Views:
    return ps.sample_views(scene, 6, 64, 48)


def moved(views: ps.Views, by: float) -> ps.Views:
    """Cameras that stand elsewhere and look the same way."""
    poses = invert_rigid(views.viewmats)
    poses[:, :3, 3] += by
    return replace(views, viewmats=invert_rigid(poses))


def in_dataset(views: ps.Views, folder: Path) -> tuple[dict, str]:
    """``transforms.json`` of cameras in the frame of a dataset, and the transforms that lead into the scene's."""
    poses = invert_rigid(views.viewmats.double())
    poses[:, :3, 3] *= 4
    poses[:, :3, 3] -= torch.tensor([1000.0, 0.0, 0.0])
    rows = torch.eye(4)[:3]
    rows[0, 3] = 1000
    return nerfstudio(replace(views, viewmats=invert_rigid(poses))), json.dumps(
        {"transform": rows.tolist(), "scale": 0.25}
    )


@pytest.mark.parametrize("beside", ["scene", "poses"])
def test_the_transforms_beside_scene_or_poses_are_applied(beside, scene, views, tmp_path):
    for name in ("scene", "poses"):
        (tmp_path / name).mkdir()
    ps.save(scene, tmp_path / "scene" / "room.ply")
    content, transforms = in_dataset(views, tmp_path)
    path = written(content, tmp_path / "poses" / "transforms.json")
    with pytest.raises(ps.DataError, match=r"0 of 6 cameras see anything of the scene.*dataparser_transforms.json"):
        read_posed(tmp_path / "scene" / "room.ply", path)
    written(transforms, tmp_path / beside / "dataparser_transforms.json")
    dense, found = read_posed(tmp_path / "scene" / "room.ply", path)
    assert len(dense) == len(scene)
    torch.testing.assert_close(found.viewmats.float(), views.viewmats.float(), rtol=0, atol=1e-3)  # of 1000 units


def test_poses_of_a_run_are_moved_and_drawn_as_the_run_was_trained(trained_walls, tmp_path):
    run = run_of(trained_walls, "wall-b")
    known = ps.dataset_views(run)
    transforms = json.loads((run / "dataparser_transforms.json").read_text())
    poses = invert_rigid(known.viewmats.double())
    poses[:, :3, 3] /= transforms["scale"]
    turn = torch.tensor(transforms["transform"], dtype=torch.float64)
    back = invert_rigid(turn[None])[0]
    original = nerfstudio(replace(known, viewmats=invert_rigid(back @ poses)))
    path = written(original, tmp_path / "transforms.json")
    for named in (run, run / "config.yml", next((run / "nerfstudio_models").glob("*.ckpt"))):
        dense, found = read_posed(named, path)
        assert dense.antialiased
        torch.testing.assert_close(found.viewmats.float(), known.viewmats.float(), rtol=0, atol=1e-5)


def test_large_pictures_are_reduced(scene, views, tmp_path):
    large = replace(views, Ks=views.Ks * torch.tensor([[50.0], [50.0], [1.0]]), width=3200, height=2400)
    _, found = read_posed(scene, written(inria(large), tmp_path / "cameras.json"))
    assert (found.width, found.height) == (1600, 1200)


@pytest.mark.parametrize("nothing", [0, 3])
def test_a_scene_of_which_nothing_is_visible_is_left_to_others(nothing, scene, views):
    check_views_show(scene[:nothing].replace(opacities=scene.opacities[:nothing] * 0 - 30), views, "a.json")


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


def test_the_frame_of_a_run_without_its_transforms_is_asked_for(trained_walls, tmp_path):
    run = shutil.copytree(run_of(trained_walls, "wall-a"), tmp_path / "run")
    ps.place(ps.load(run), original_frame=run)
    (run / "dataparser_transforms.json").unlink()
    for named in (run, run / "config.yml", next((run / "nerfstudio_models").glob("*.ckpt"))):
        with pytest.raises(
            SceneError, match=r"run/dataparser_transforms.json: no such file.*copy it from the original"
        ):
            ps.place(ps.load(run), original_frame=named)
    with pytest.raises(SystemExit):
        main(["convert", str(run), str(tmp_path / "a.ply"), "--original-frame"])
    assert not (tmp_path / "a.ply").exists()


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
