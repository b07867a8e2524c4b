"""Trained scenes: how they are named, their dataparser as it was at the training, and what a step gets."""

import json
import os
from pathlib import Path
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.io.runs import open_run
from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene, dataparser_of

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


def test_an_unknown_dataparser_is_refused_and_a_setting_left_out(wall_config, wall_scene, tmp_path):
    run = make_run(tmp_path, wall_config, wall_scene)
    config = run / "config.yml"
    text = config.read_text()
    parser = "pointsplat_ns.nerfstudio_plugin.replica.dataparser.ReplicaDataParserConfig"
    config.write_text(text.replace(parser, "json.JSONDecoder"))
    with pytest.raises(SceneError, match="config.yml: trained with the dataparser json.JSONDecoder.*not installed"):
        dataparser_of(open_run(run))
    config.write_text(text.replace("frame_stride: 1", "frame_stride: 1\n      an_option_of_then: null"))
    assert dataparser_of(open_run(run)).config.frame_stride == 1, "what was not given need not exist any more"
    config.write_text(text.replace("frame_stride:", "frame_leap:"))
    with mock.patch("pointsplat_ns.nerfstudio_plugin.pointsplat.scenes.CONSOLE.log") as log:
        assert dataparser_of(open_run(run)).config.frame_stride == 1
    assert log.call_args.args[0].endswith("settings that its dataparser no longer has are left out: frame_leap")


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
        shares = [config.setup(test_mode="val", world_size=size, local_rank=rank) for rank in range(size)]
        together = [photos_of(share, step) for step in range(12 // size) for share in shares]
        assert together == alone
