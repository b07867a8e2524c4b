"""Trained scenes: how they are named, their dataparser as it was at the training, and what a step gets."""

import json
import os
from pathlib import Path
from unittest import mock

import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetppDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from making import run_of, without_data
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.io.runs import open_run
from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene, dataparser_of
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig

NUM_TRAIN, NUM_HELD_OUT = 9, 2  # of the wall's 11 frames, every tenth held out


def manager_of(folder: Path, **settings):
    return ScenesDataManagerConfig(data=folder, cache_gigabytes=0.01, **settings).setup(test_mode="val")


def make_run(folder: Path, wall_config, scene: Path, change=lambda config: None) -> Path:
    """A run folder as nerfstudio lays it out, with an empty checkpoint; ``change`` edits the config first."""
    config = wall_config(scene, folder, steps=1)
    change(config)
    config.save_config()
    run = config.get_base_dir()
    config.get_checkpoint_dir().mkdir()
    torch.save({"step": 0, "pipeline": {}}, config.get_checkpoint_dir() / "step-000000000.ckpt")
    return run


def scene_of(run: Path) -> TrainedScene:
    return TrainedScene("scene", open_run(run), MemoryCache(1 << 20))


def test_a_run_a_config_and_a_checkpoint_each_name_one_scene(trained_walls):
    run = run_of(trained_walls, "wall-a")
    for path in (run, run / "config.yml", next((run / "nerfstudio_models").iterdir())):
        manager = manager_of(path)
        assert [scene.name for scene in manager.scenes] == ["wall-a"]
        assert manager.train_indices == manager.eval_indices == [0] and manager.shown == 0


def test_held_out_scenes_are_evaluated_and_shown_and_never_trained_on(trained_walls):
    manager = manager_of(trained_walls, eval_scenes=("wall-b",))
    assert manager.train_indices == [0] and manager.eval_indices == [1] and manager.shown == 1
    assert {manager.next_train(step)[0] for step in range(6)} == {0}
    assert {manager.next_eval(step)[0] for step in range(6)} == {1}
    assert "train_frames" not in manager_of(trained_walls, eval_scenes=("wall-b",)).scenes[0].__dict__


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


def test_a_run_of_another_method_is_refused_when_it_is_named_itself(wall_config, wall_scene, tmp_path):
    def nerf(config):
        from nerfstudio.models.nerfacto import NerfactoModelConfig

        config.method_name, config.pipeline.model = "nerfacto", NerfactoModelConfig()

    run = make_run(tmp_path, wall_config, wall_scene, nerf)
    with pytest.raises(SceneError, match="method nerfacto; expected a trained Splatfacto run"):
        manager_of(run)


def test_the_dataparser_is_set_up_as_it_was_but_for_seed_points(wall_config, wall_scene, tmp_path):
    def change(config):
        config.pipeline.datamanager.dataparser = ReplicaDataParserConfig(
            frame_stride=2, eval_frames=(4,), scale_factor=2.5, pixel_centers="half"
        )

    run = make_run(tmp_path, wall_config, wall_scene, change)
    (run / "dataparser_transforms.json").write_text(json.dumps({"transform": torch.eye(4)[:3].tolist(), "scale": 2.5}))
    config = dataparser_of(open_run(run)).config
    settings = {"frame_stride": 2, "eval_frames": (4,), "scale_factor": 2.5, "pixel_centers": "half"}
    assert config == ReplicaDataParserConfig(data=wall_scene, load_seed_points=False, **settings)
    scene = scene_of(run)
    names = [Path(p).stem for p in scene.train_frames.dataset.image_filenames]
    assert names == [f"frame{i:06d}" for i in (0, 2, 6, 8, 10)]
    assert [Path(p).stem for p in scene.eval_frames.dataset.image_filenames] == ["frame000004"]
    # The wall's cameras stand at z = -2 scene units.
    assert scene.train_frames.dataset.cameras.camera_to_worlds[:, 2, 3].tolist() == [-5.0] * 5
    assert "points3D_xyz" not in scene.train_frames.dataset.metadata


@pytest.mark.parametrize(
    ("config", "names"),
    [(ScanNetppDataParserConfig(), ()), (NerfstudioDataParserConfig(load_3D_points=True), ("load_3D_points",))],
    ids=["scannetpp-data", "nerfstudio-data"],
)
def test_nerfstudios_own_dataparsers_are_known(wall_config, wall_scene, tmp_path, config, names):
    run = make_run(tmp_path, wall_config, wall_scene, lambda c: setattr(c.pipeline.datamanager, "dataparser", config))
    found = dataparser_of(open_run(run)).config
    assert type(found) is type(config) and found.data == wall_scene
    assert not any(getattr(found, name) for name in names), "seed points are of no use to a trained scene"


def test_an_unknown_dataparser_and_an_unknown_setting_are_refused(wall_config, wall_scene, tmp_path):
    run = make_run(tmp_path, wall_config, wall_scene)
    config = run / "config.yml"
    text = config.read_text()
    config.write_text(
        text.replace("pointsplat_ns.nerfstudio_plugin.replica.dataparser.ReplicaDataParserConfig", "json.JSONDecoder")
    )
    with pytest.raises(SceneError, match="config.yml: trained with the dataparser json.JSONDecoder.*not installed"):
        dataparser_of(open_run(run))
    config.write_text(text.replace("frame_stride:", "frame_leap:"))
    with pytest.raises(SceneError, match="config.yml: its dataparser has no setting 'frame_leap'"):
        dataparser_of(open_run(run))


def test_code_in_a_config_is_never_run(wall_config, wall_scene, tmp_path):
    run = make_run(tmp_path, wall_config, wall_scene)
    config, trap = run / "config.yml", tmp_path / "sprung"
    bomb = f"!!python/object/apply:os.system ['touch {trap}']"
    config.write_text(config.read_text().replace("frame_stride: 1", f"frame_stride: {bomb}"))
    assert bomb in config.read_text()
    with mock.patch.object(os, "system", side_effect=AssertionError("the config was run")):
        scene = scene_of(run)
        assert len(scene.train_frames) == NUM_TRAIN, "the default stands where the config holds an object"
        manager_of(run)
    assert not trap.exists()


def test_poses_in_another_frame_are_refused_in_training_and_in_evaluation(wall_config, wall_scene, tmp_path):
    run = make_run(tmp_path, wall_config, wall_scene)
    moved = torch.eye(4)[:3]
    moved[0, 3] = 0.5
    (run / "dataparser_transforms.json").write_text(json.dumps({"transform": moved.tolist(), "scale": 1.0}))
    for split in ("train_frames", "eval_frames"):
        with pytest.raises(DataError, match="no longer in the frame.*differs by 0.5") as caught:
            getattr(scene_of(run), split)
        assert str(wall_scene) in str(caught.value) and "\n" not in str(caught.value)
    (run / "dataparser_transforms.json").write_text(json.dumps({"transform": torch.eye(4)[:3].tolist(), "scale": 1.01}))
    with pytest.raises(DataError, match="the scale is 1 and was 1.01"):
        _ = scene_of(run).train_frames


def test_photos_have_the_resolution_that_the_run_was_trained_at(wall_config, wall_scene, tmp_path):
    run = make_run(
        tmp_path, wall_config, wall_scene, lambda c: setattr(c.pipeline.datamanager, "camera_res_scale_factor", 0.5)
    )
    scene = scene_of(run)
    for frames, count in ((scene.train_frames, NUM_TRAIN), (scene.eval_frames, NUM_HELD_OUT)):
        camera, data = frames[0]
        assert len(frames) == count
        assert data["image"].shape == (24, 32, 3)
        assert (int(camera.width), int(camera.height), float(camera.fx)) == (32, 24, 30.0)  # of 64, 48 and 60
        same = InputDataset(scene._dataparser.get_dataparser_outputs("train"), 0.5)
        if frames is scene.train_frames:
            torch.testing.assert_close(data["image"].float() / 255, same.get_image_float32(0), atol=0, rtol=0)


def photos_of(manager, step):
    scene, frames = manager.next_train(step)
    return scene, [data["image_idx"] for _, data in frames]


def test_each_epoch_has_each_scene_once_and_photos_differ(trained_walls):
    manager = manager_of(trained_walls)
    steps = [photos_of(manager, step) for step in range(40)]
    for i in range(0, 40, 2):
        assert {steps[i][0], steps[i + 1][0]} == {0, 1}
    assert len({steps[i][0] for i in range(0, 40, 2)}) == 2, "the order of scenes varies"
    assert all(len(set(photos)) == 2 for _, photos in steps)
    assert {i for _, photos in steps for i in photos} == set(range(NUM_TRAIN)), "every training photo has its turn"


def test_a_step_gets_the_same_whatever_came_before_it_and_processes_share_it_out(trained_walls):
    one, second, other = (manager_of(trained_walls, **seed) for seed in ({}, {}, {"seed": 1}))
    alone = [photos_of(one, step) for step in range(12)]
    assert alone == [photos_of(second, step) for step in reversed(range(12))][::-1]
    assert alone != [photos_of(other, step) for step in range(12)]
    config = ScenesDataManagerConfig(data=trained_walls, cache_gigabytes=0.01)
    for size in (2, 3):
        shares = [config.setup(test_mode="val", world_size=size, local_rank=rank) for rank in range(size)]
        together = [photos_of(share, step) for step in range(12 // size) for share in shares]
        assert together == alone


def test_inference_needs_no_photos(trained_walls, tmp_path):
    without_data(trained_walls, tmp_path / "runs")
    with pytest.raises(SceneError, match="gone_from_here.*is not there"):
        manager_of(tmp_path / "runs")
    manager = ScenesDataManagerConfig(data=tmp_path / "runs").setup(test_mode="inference")
    assert manager.train_dataset is None and manager.eval_dataset is None
    assert len(manager.scenes[0].read_dense()) > 0
