"""The scenes of a training: runs, and dense scenes as their own references; and what a step
gets."""

import json
import os
from pathlib import Path
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from making import box_room
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.nerfstudio_plugin.cameras import carried
from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat import dense_scenes
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene, dataparser_of
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.runs import open_run
from pointsplat_ns.scene.views import EPS2D, Views
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")


def manager_of(folder: Path, **settings):
    return ScenesDataManagerConfig(data=folder, cache_gigabytes=0.01, **settings).setup(
        test_mode="val"
    )


@pytest.fixture
def run(tmp_path, wall_config, wall_scene) -> Path:
    """A run folder as nerfstudio lays it out, with an empty checkpoint."""
    config = wall_config(wall_scene, tmp_path, steps=1)
    config.write_config()
    config.get_checkpoint_dir().mkdir()
    torch.save({"step": 0, "pipeline": {}}, config.get_checkpoint_dir() / "step-000000000.ckpt")
    return config.get_base_dir()


def scene_of(run: Path) -> TrainedScene:
    return TrainedScene("scene", open_run(run), MemoryCache(1 << 20))


def test_what_cannot_be_a_scene_says_what_is_wrong(trained_walls, tmp_path):
    with pytest.raises(SceneError, match="nothing_here.*no such folder"):
        manager_of(tmp_path / "nothing_here")
    with pytest.raises(SceneError, match="--data is missing"):
        ScenesDataManagerConfig().setup()
    with pytest.raises(SceneError, match="--eval-scenes wall-c: no such scene.*wall-a, wall-b"):
        manager_of(trained_walls, eval_scenes=("wall-a", "wall-c"))
    with pytest.raises(SceneError, match="all 2 scenes"):
        manager_of(trained_walls, eval_scenes=("wall-a", "wall-b"))
    with pytest.raises(DataError, match="--images-per-step 0"):
        manager_of(trained_walls, images_per_step=0)


def test_an_unknown_dataparser_is_refused_and_a_setting_left_out(run):
    config = run / "config.yml"
    text = (run / "config.yml").read_text()
    parser = "pointsplat_ns.nerfstudio_plugin.replica.dataparser.ReplicaDataParserConfig"
    config.write_text(text.replace(parser, "json.JSONDecoder"))
    with pytest.raises(
        SceneError, match="config.yml: trained with the dataparser json.JSONDecoder.*not installed"
    ):
        dataparser_of(open_run(run))
    config.write_text(
        text.replace("frame_stride: 1", "frame_stride: 1\n      an_option_of_then: null")
    )
    assert dataparser_of(open_run(run)).config.frame_stride == 1, (
        "what was not given need not exist any more"
    )
    config.write_text(text.replace("frame_stride:", "frame_leap:"))
    with mock.patch("pointsplat_ns.nerfstudio_plugin.console.CONSOLE.log") as log:
        assert dataparser_of(open_run(run)).config.frame_stride == 1
    assert log.call_args.args[0].endswith(
        "settings that its dataparser no longer has are left out: frame_leap"
    )


def test_code_in_a_config_is_never_run(run):
    config = run / "config.yml"
    text = config.read_text().replace(
        "frame_stride: 1", "frame_stride: !!python/object/apply:os.system ['true']"
    )
    config.write_text(text)
    assert "os.system" in text
    with mock.patch.object(os, "system", side_effect=AssertionError("the config was run")):
        assert len(scene_of(run).frames("train")) == 9, (
            "the default stands where the config holds an object"
        )
        manager_of(run)


def test_poses_in_another_frame_are_refused_in_training_and_in_evaluation(run, wall_scene):
    moved = torch.eye(4)[:3]
    moved[0, 3] = 0.5
    (run / "dataparser_transforms.json").write_text(
        json.dumps({"transform": moved.tolist(), "scale": 1.0})
    )
    for split in ("train", "test"):
        with pytest.raises(DataError, match="no longer in the frame.*differs by 0.5") as caught:
            scene_of(run).frames(split)
        assert str(wall_scene) in str(caught.value) and "\n" not in str(caught.value)
    (run / "dataparser_transforms.json").write_text(
        json.dumps({"transform": torch.eye(4)[:3].tolist(), "scale": 1.01})
    )
    with pytest.raises(DataError, match="the scale is 1 and was 1.01"):
        _ = scene_of(run).frames("train")


def photos_of(manager, step):
    scene, frames = manager.next_train(step)
    return scene, [data["image_idx"] for _, data in frames]


def test_a_step_depends_on_its_number_alone_and_processes_share_it(trained_walls):
    one, second, other = (manager_of(trained_walls, **seed) for seed in ({}, {}, {"seed": 1}))
    alone = [photos_of(one, step) for step in range(12)]
    assert alone == [photos_of(second, step) for step in reversed(range(12))][::-1]
    assert alone != [photos_of(other, step) for step in range(12)]
    config = ScenesDataManagerConfig(data=trained_walls, cache_gigabytes=0.01)
    for size in (2, 3):
        shares = [
            config.setup(test_mode="val", world_size=size, local_rank=rank) for rank in range(size)
        ]
        together = [photos_of(share, step) for step in range(12 // size) for share in shares]
        assert together == alone


def test_steps_of_one_scene_draw_different_photos(trained_walls):
    manager = manager_of(trained_walls)
    steps = [photos_of(manager, step) for step in range(24)]
    for scene in manager.train_indices:
        drawn = [tuple(photos) for found, photos in steps if found == scene]
        assert len(drawn) == 12
        assert len(set(drawn)) > 6  # of 12 draws of 2 of 10 photos, about 11 differ


def test_epochs_have_the_scenes_in_different_orders(trained_walls):
    manager = manager_of(trained_walls)
    orders = {tuple(manager.scene_at(2 * epoch + i) for i in range(2)) for epoch in range(16)}
    assert orders == {(0, 1), (1, 0)}


def test_evaluations_show_different_photos(trained_walls, monkeypatch):
    manager = manager_of(trained_walls)
    frames = [*range(7)]
    for scene in manager.scenes:
        monkeypatch.setattr(scene, "frames", lambda split: frames)
    shown = {manager.next_eval_image(step)[1][0] for step in range(0, 24, 2)}
    assert len(shown) > 3


POSES = ScenesDataManagerConfig(sampled_poses=6, sampled_size=(32, 24), seed=1)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """A folder of two PLY rooms, one in a folder of its own, beside a point cloud that is no
    scene."""
    folder = tmp_path_factory.mktemp("rooms")
    write_ply(box_room(1), folder / "one.ply")
    (folder / "deep" / "iteration_7").mkdir(parents=True)
    write_ply(box_room(2), folder / "deep" / "iteration_7" / "point_cloud.ply")
    (folder / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    )
    (folder / "broken.ply").write_text("nothing")
    return folder


def dense_scene(rooms: Path) -> DenseScene:
    return DenseScene("one", rooms / "one.ply", MemoryCache(1 << 24), POSES)


def test_a_folder_of_ply_files_is_scenes_learned_from_their_own_renders(rooms):
    manager = manager_of(rooms)
    assert [scene.name for scene in manager.scenes] == ["deep-iteration_7-point_cloud", "one"]
    assert manager.supervision == "dense" and not any(scene.has_photos for scene in manager.scenes)
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
    with pytest.raises(DataError, match="0 sampled poses of 320 x 240 pixels"):
        manager_of(rooms, sampled_poses=0)


def test_sampled_poses_are_the_same_each_time_and_none_is_in_both_splits(rooms, monkeypatch):
    monkeypatch.setattr(dense_scenes, "sample_views", sample_views)  # anew for each
    scene = dense_scene(rooms)
    train, held_out = (
        scene.frames(split).dataset.cameras.camera_to_worlds for split in ("train", "test")
    )
    assert len(train) == 6 and len(held_out) == 1
    assert torch.equal(dense_scene(rooms).cameras("train").camera_to_worlds, train)
    assert torch.cdist(train.reshape(-1, 12), held_out.reshape(-1, 12)).min() > 1e-3


def test_targets_are_the_dense_scenes_exact_renders_in_8_bits(rooms):
    scene = dense_scene(rooms)
    assert not scene.dense(keep=False).means.requires_grad
    for frames, tolerance in (
        (scene.rendered["train"], 0.5 / 255 + 1e-6),
        (scene.rendered["test"], 1e-6),
    ):
        camera, data = frames[-1]
        poses = viewmats_from_opengl(camera.camera_to_worlds)
        Ks = camera.get_intrinsics_matrices()
        views = Views(poses, Ks, 32, 24, scene.background, **carried(camera))
        image = data["image"].float() / (255 if data["image"].dtype == torch.uint8 else 1)
        # half a level where they are rounded, float32 noise where they are not
        torch.testing.assert_close(
            image, render(scene.read_dense(), views[0]), atol=tolerance, rtol=0
        )
        assert (
            data["image_idx"] == len(frames) - 1
            and image.std() > 0.05
            and not data["image"].requires_grad
        )
    image = scene.rendered["train"][0][1]["image"]
    assert image.dtype == torch.uint8
    assert torch.equal(scene.rendered["train"].dataset[0]["image"], image / 255), (
        "what the viewer shows"
    )
    # Every second training picture is subsampled from one of the size that people look at.
    assert [carried(camera)["eps2d"] for camera, _ in scene.rendered["train"]] == 3 * [
        EPS2D,
        EPS2D * (32 / 1920) ** 2,
    ]
    assert [carried(camera)["eps2d"] for camera, _ in scene.rendered["test"]] == [EPS2D]
