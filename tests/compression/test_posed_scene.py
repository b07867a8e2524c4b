"""A scene and the poses of a file are brought into one frame, and checked to be in one before any long work."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import ball, run_of
from pointsplat_ns.compression.posed_scene import check_views_show, read_posed
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import invert_rigid
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


def test_half_of_the_cameras_may_see_nothing(scene, views):
    away = moved(views, 1000.0)
    check_views_show(scene, views, "a.json")
    for seeing in (3, 4):
        check_views_show(
            scene, replace(views, viewmats=torch.cat([views.viewmats[:seeing], away.viewmats[seeing:]])), "a.json"
        )
    with pytest.raises(ps.DataError, match="^a.json: 2 of 6 cameras see anything of the scene; expected at least half"):
        check_views_show(scene, replace(views, viewmats=torch.cat([views.viewmats[:2], away.viewmats[2:]])), "a.json")


def test_a_scene_that_is_a_dot_in_every_picture_is_not_seen(scene, views):
    far = invert_rigid(views.viewmats.double())
    far[:, :3, 3] = -1000 * far[:, :3, 2]  # all look at the middle
    far = replace(views, viewmats=invert_rigid(far))
    with pytest.raises(ps.DataError, match="0 of 6 cameras see anything"):
        check_views_show(scene, far, "a.json")
    long = torch.tensor([[50.0, 1.0, 1.0], [1.0, 50.0, 1.0], [1.0, 1.0, 1.0]])
    check_views_show(scene, replace(far, Ks=far.Ks * long), "a.json")


@pytest.mark.parametrize("nothing", [0, 3])
def test_a_scene_of_which_nothing_is_visible_is_left_to_others(nothing, scene, views):
    check_views_show(scene[:nothing].replace(opacities=scene.opacities[:nothing] * 0 - 30), views, "a.json")
