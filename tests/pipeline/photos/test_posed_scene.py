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
from making import cloud, run_of, views_from_within
from pointsplat_ns.cli import main
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.geometry.transforms import direction_of, invert_rigid
from pointsplat_ns.pipeline.photos.posed_scene import read_scene_and_cameras
from pointsplat_ns.scene.camera_files import read_named_views
from pointsplat_ns.scene.rotation import Similarity
from pointsplat_ns.tools.placing import run_frame
from posing import nerfstudio, write_photos, write_sparse, written

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def views(scene) -> ps.Views:
    return views_from_within((0.0, 0.0, 0.0), 6, 64, 48)


def in_dataset(views: ps.Views, folder: Path) -> tuple[dict, str]:
    """``transforms.json`` of cameras in the frame of a dataset, and the transforms that lead into
    the scene's."""
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
    with pytest.raises(
        ps.DataError, match=r"0 of 6 cameras see anything of the scene.*dataparser_transforms.json"
    ):
        read_scene_and_cameras(tmp_path / "scene" / "room.ply", path)
    written(transforms, tmp_path / beside / "dataparser_transforms.json")
    dense, found, _ = read_scene_and_cameras(tmp_path / "scene" / "room.ply", path)
    assert len(dense) == len(scene)
    torch.testing.assert_close(
        found.viewmats.float(), views.viewmats.float(), rtol=0, atol=1e-3
    )  # of 1000 units
    ps.save(
        scene.replace(means=scene.means + 1000), tmp_path / "scene" / "room.ply", overwrite=True
    )
    with pytest.raises(ps.DataError, match="dataparser_transforms.json belongs to another run"):
        read_scene_and_cameras(tmp_path / "scene" / "room.ply", path)


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
        dense, found, _ = read_scene_and_cameras(named, path)
        assert dense.antialiased
        torch.testing.assert_close(
            found.viewmats.float(), known.viewmats.float(), rtol=0, atol=1e-5
        )


def turned_about(views: ps.Views) -> ps.Views:
    """Cameras in another frame, whose x, y and z are the scene's y, z and x."""
    turn = torch.eye(4, dtype=torch.float64)[[1, 2, 0, 3]]
    return replace(views, viewmats=views.viewmats.double() @ turn)


@pytest.mark.parametrize("layout", ["nerfstudio", "scannet++", "colmap"])
def test_photos_that_lie_where_the_file_says_tell_a_wrong_frame(layout, scene, views, tmp_path):
    """From inside a ball every frame shows it, sharp: photos alone tell."""
    photos = {"scannet++": tmp_path / "dslr" / "resized_images"}.get(layout, tmp_path / "images")
    write_photos(scene, views, photos)

    def poses_of(views: ps.Views) -> Path:
        if layout == "colmap":
            return write_sparse(views, tmp_path / "sparse" / "0")
        content = nerfstudio(views)
        if layout == "nerfstudio":
            return written(content, tmp_path / "transforms.json")
        for frame in content["frames"]:
            frame["file_path"] = Path(frame["file_path"]).name
        (tmp_path / "dslr" / "nerfstudio").mkdir(exist_ok=True)
        return written(content, tmp_path / "dslr" / "nerfstudio" / "transforms.json")

    _, found, _ = read_scene_and_cameras(scene, poses_of(views))
    assert len(found) == len(views)
    with pytest.raises(
        ps.DataError,
        match=r"match the photos of their views no better than other photos \(.* dB PSNR in 6",
    ):
        read_scene_and_cameras(scene, poses_of(turned_about(views)))
    for photo in photos.iterdir():
        photo.write_bytes(b"no photo")
    read_scene_and_cameras(scene, poses_of(turned_about(views)))  # nothing to compare with


def test_no_photo_outside_of_the_folder_of_poses_is_opened(scene, views, tmp_path):
    write_photos(scene, views, tmp_path / "images")
    content = nerfstudio(turned_about(views))
    (tmp_path / "in").mkdir()
    for frame in content["frames"]:
        frame["file_path"] = f"../{frame['file_path']}"
    found = read_named_views(written(content, tmp_path / "in" / "transforms.json"))
    assert [found.photo(index) for index in range(6)] == [None] * 6


def rotation():
    q, _ = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    )
    return q * torch.linalg.det(q).sign()


def test_a_scene_that_is_moved_looks_the_same_from_cameras_that_move_along():
    scene = cloud(300, 4, 3).to(dtype=torch.float64)
    similarity = Similarity(rotation(), 2.5, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    views = ps.sample_views(scene, 2, width=48, height=36)
    inverse = similarity.inverse()
    viewmats = views.viewmats.clone()
    viewmats[:, :3, :3] = views.viewmats[:, :3, :3] @ inverse.matrix
    # The camera's axes keep their unit, so that depths grow with the scene.
    viewmats[:, :3, 3] = similarity.scale * (
        views.viewmats[:, :3, :3] @ inverse.offset + views.viewmats[:, :3, 3]
    )
    moved = replace(views, viewmats=viewmats, near_plane=similarity.scale * views.near_plane)
    apart = ps.render(scene, views) - ps.render(similarity.apply(scene), moved)
    assert float(apart.abs().max()) < 1e-4  # the steps of blending are float32


def test_up_is_turned_to_where_it_is_wanted():
    scene = cloud(20, 4)
    for start, end in (("z", "y"), ("-y", "z"), ("x", "-x"), ("z", "z")):
        turned = ps.place(scene, up=f"{start}:{end}")
        now, wanted = (direction_of(text) for text in (start, end))
        assert torch.allclose(scene.means.double() @ now, turned.means.double() @ wanted, atol=1e-6)


def test_up_is_estimated_where_it_is_not_said():
    room = ps.example_room()[::20]
    turned = ps.place(room, up="z:-y")
    back = ps.place(turned, up="z")
    # Estimated to half a degree; the room is 6 m wide.
    assert float((back.means[:, 2] - room.means[:, 2]).abs().max()) < 0.1


def test_the_frame_of_a_run_is_undone(tmp_path):
    turn = rotation()
    transform = torch.cat([turn, torch.tensor([[0.5], [-0.25], [1.0]])], dim=1).float()
    run = SimpleNamespace(folder=tmp_path, transform=transform, scale=0.125)
    data = cloud(40, 4)
    scene = run_frame(run).apply(data)  # what nerfstudio does to poses
    expected = 0.125 * (
        data.means.double() @ transform[:, :3].double().T + transform[:, 3].double()
    )
    assert torch.allclose(scene.means.double(), expected, atol=1e-5)
    assert torch.allclose(run_frame(run).inverse().apply(scene).means, data.means, atol=1e-5)


def test_the_frame_of_a_run_without_its_transforms_is_asked_for(trained_walls, tmp_path):
    run = shutil.copytree(run_of(trained_walls, "wall-a"), tmp_path / "run")
    ps.place(ps.load(run), original_frame=run)
    (run / "dataparser_transforms.json").unlink()
    for named in (run, run / "config.yml", next((run / "nerfstudio_models").glob("*.ckpt"))):
        with pytest.raises(
            SceneError,
            match=r"run/dataparser_transforms.json: no such file.*copy it from the original",
        ):
            ps.place(ps.load(run), original_frame=named)
    with pytest.raises(SystemExit):
        main(["convert", str(run), str(tmp_path / "a.ply"), "--original-frame"])
    assert not (tmp_path / "a.ply").exists()


def test_a_transform_that_is_no_similarity_is_refused(tmp_path):
    run = SimpleNamespace(
        folder=tmp_path, transform=torch.diag(torch.tensor([1.0, 2.0, 3.0, 1.0]))[:3], scale=1.0
    )
    with pytest.raises(SceneError, match="not a rotation with one scale"):
        run_frame(run)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"up": up}, "expected an axis such as z") for up in ("w", "", "z:", "z:y:x", "north")),
        *(
            ({"scale": scale}, "expected a number above 0")
            for scale in (0.0, -1.0, math.nan, math.inf)
        ),
    ],
)
def test_an_axis_or_a_scale_that_is_none_is_refused(options, message):
    with pytest.raises(PointSplatError, match=message):
        ps.place(cloud(3), **options)
