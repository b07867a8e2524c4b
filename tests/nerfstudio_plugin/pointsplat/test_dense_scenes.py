"""Dense scenes as their own references: which scenes a folder holds, their poses, their pictures, and the memory."""

from pathlib import Path

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from making import box_room
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.io import write_ply
from pointsplat_ns.io.discovery import find_plys
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.nerfstudio_plugin.cameras import carried
from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat import dense_scenes
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import EPS2D, Views

POSES = ScenesDataManagerConfig(sampled_poses=6, sampled_size=(32, 24), seed=1)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """A folder of two PLY rooms, one in a folder of its own, beside a point cloud that is no scene."""
    folder = tmp_path_factory.mktemp("rooms")
    write_ply(box_room(1), folder / "one.ply")
    (folder / "deep" / "iteration_7").mkdir(parents=True)
    write_ply(box_room(2), folder / "deep" / "iteration_7" / "point_cloud.ply")
    (folder / "cloud.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    (folder / "broken.ply").write_text("nothing")
    return folder


def scene_of(rooms: Path, cache_bytes: int = 1 << 24) -> DenseScene:
    return DenseScene("one", rooms / "one.ply", MemoryCache(cache_bytes), POSES)


def manager_of(folder: Path, **settings):
    settings = {"sampled_poses": 6, "sampled_size": (32, 24), "cache_gigabytes": 0.01, **settings}
    return ScenesDataManagerConfig(data=folder, **settings).setup(test_mode="val")


def test_a_folder_of_ply_files_is_scenes_learned_from_their_own_renders(rooms):
    manager = manager_of(rooms)
    assert [scene.name for scene in manager.scenes] == ["deep-iteration_7-point_cloud", "one"]
    assert manager.supervision == "dense" and not any(scene.has_photos for scene in manager.scenes)
    assert [name for name, _ in find_plys(rooms / "one.ply")] == ["one"]
    assert [scene.name for scene in manager_of(rooms / "one.ply").scenes] == ["one"]


def test_what_holds_no_scene_says_so(rooms, tmp_path):
    with pytest.raises(SceneError, match="no trained Splatfacto run below it.*or 3DGS PLY files"):
        manager_of(tmp_path)
    for data in (rooms, rooms / "one.ply"):
        with pytest.raises(SceneError, match="supervision dense"):
            manager_of(data, supervision="photos")
    with pytest.raises(SceneError, match="cloud.ply: no Gaussians in it; expected a 3DGS .ply"):
        manager_of(rooms / "cloud.ply")
    with pytest.raises(SceneError, match="two.ply: no such file"):
        manager_of(rooms / "two.ply")
    with pytest.raises(DataError, match="0 sampled poses of 32 x 24 pixels"):
        manager_of(rooms, sampled_poses=0)


def test_sampled_poses_are_the_same_each_time_and_none_is_in_both_splits(rooms, monkeypatch):
    monkeypatch.setattr(dense_scenes, "sample_views", sample_views)  # anew for each
    first, second = scene_of(rooms), scene_of(rooms)
    assert len(first.train_frames) == 6 and len(first.eval_frames) == 1
    for split in ("train", "test"):
        assert torch.equal(first.cameras(split).camera_to_worlds, second.cameras(split).camera_to_worlds)
    train, held_out = (first.cameras(split).camera_to_worlds.reshape(-1, 12) for split in ("train", "test"))
    assert torch.cdist(train, held_out).min() > 1e-3


def test_targets_are_the_dense_scenes_exact_renders_in_8_bits(rooms):
    scene = scene_of(rooms)
    assert not scene.dense(keep=False).means.requires_grad
    for frames, tolerance in ((scene.rendered_train, 0.5 / 255 + 1e-6), (scene.rendered_eval, 1e-6)):
        camera, data = frames[-1]
        views = Views(
            viewmats_from_opengl(camera.camera_to_worlds), camera.get_intrinsics_matrices(), 32, 24, scene.background,
            **carried(camera),
        )  # fmt: skip
        image = data["image"].float() / (255 if data["image"].dtype == torch.uint8 else 1)
        # half a level where they are rounded, float32 noise where they are not
        torch.testing.assert_close(image, render(scene.read_dense(), views[0]), atol=tolerance, rtol=0)
        assert data["image_idx"] == len(frames) - 1 and image.std() > 0.05 and not data["image"].requires_grad
    image = scene.rendered_train[0][1]["image"]
    assert image.dtype == torch.uint8
    assert torch.equal(scene.rendered_train.dataset[0]["image"], image / 255), "what the viewer shows"
    with pytest.raises(IndexError):
        scene.rendered_train[6]
    # Every second training picture is subsampled from one of the size that people look at.
    assert [carried(camera)["eps2d"] for camera, _ in scene.rendered_train] == 3 * [EPS2D, EPS2D * (32 / 1920) ** 2]
    assert [carried(camera)["eps2d"] for camera, _ in scene.rendered_eval] == [EPS2D]
