"""Training across scenes without photos: dense supervision, exact resuming, rates and schedules."""

import json
import shutil
from pathlib import Path
from unittest import mock

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import dense_config


@pytest.fixture(scope="module")
def trained(three_rooms, run_training, tmp_path_factory):
    config = dense_config(three_rooms, tmp_path_factory.mktemp("refined"), steps=16)
    for group in config.optimizers.values():
        group["optimizer"].lr *= 10  # tests take few steps
    config.pipeline.datamanager.eval_scenes = ("room2",)
    trainer, _ = run_training(config)
    return config, trainer


def test_a_folder_of_ply_files_trains_the_refiner(trained, no_lpips):
    config, trainer = trained
    pipeline = trainer.pipeline
    report = pipeline.get_average_eval_image_metrics()
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert report["supervision"] == "dense" and report["reference"] == "dense renders"
    for name, block in report["scenes"].items():
        assert block["reference"] == "dense renders" and block["views"] == 1
        assert block["seen_in_training"] == (name != "room2")
        assert block["dense"]["psnr"] is None or block["dense"]["psnr"] > 100, "it is the reference: float32 noise"
        # dB; 16 steps give the training scenes 1.5 or more
        assert block["refined"]["psnr"] > block["pruned"]["psnr"] + (0.5 if name != "room2" else 0.0)
    opened = eval_setup(config.get_base_dir() / "config.yml")[1].get_average_eval_image_metrics()
    assert opened["psnr"] == report["psnr"] and opened["scenes"]["room2"]["seen_in_training"] is False


def test_no_mean_mixes_photos_and_dense_renders(trained_walls, three_rooms, tmp_path, no_lpips):
    shutil.copytree(trained_walls, tmp_path / "all")
    shutil.copy(three_rooms / "room0.ply", tmp_path / "all")
    config = dense_config(tmp_path / "all", tmp_path, 1)
    config.pipeline.datamanager.supervision = "dense"
    report = config.pipeline.setup(device="cpu", test_mode="test").eval().get_average_eval_image_metrics(get_std=True)
    json.dumps(report, allow_nan=False)
    scenes = report["scenes"]
    references = {name: block["reference"] for name, block in scenes.items()}
    assert references == {"wall-a": "photos", "wall-b": "photos", "room0": "dense renders"}
    walls = [scenes[name]["refined"]["psnr"] for name in ("wall-a", "wall-b")]
    assert report["reference"] == "photos" and report["psnr"] == pytest.approx(sum(walls) / 2)
    assert report["average"]["refined"]["psnr"] == report["psnr"]


def test_the_loss_is_against_the_dense_scene_even_where_there_are_photos(trained_walls):
    config = dense_config(trained_walls, Path("unused"), 1)
    config.pipeline.model.keep = 1.0
    losses = {}
    for supervision in ("photos", "dense"):
        config.pipeline.datamanager.supervision = supervision
        pipeline = config.pipeline.setup(device="cpu", test_mode="val")
        losses[supervision] = float(pipeline.get_train_loss_dict(0)[1]["l1"].detach())
    # an untrained refiner that keeps all is the dense scene, but for the rounding of its renders to 8 bits
    assert losses["dense"] < 0.5 / 255 and losses["photos"] > 5 / 255


def test_random_choices_after_resuming_are_those_of_an_unbroken_run(three_rooms):
    pipeline = dense_config(three_rooms, Path("unused"), 1).pipeline.setup(device="cpu", test_mode="val").train()
    blocks = [m for m in pipeline.model.refiner.modules() if hasattr(m, "drop_path")]
    for block in blocks:
        block.drop_path = 0.5
    for parameter in pipeline.model.refiner.heads.parameters():  # or residuals are zero, whatever is dropped
        torch.nn.init.normal_(parameter, std=0.05)
    first = [float(pipeline.get_train_loss_dict(step)[1]["l1"].detach()) for step in (0, 3, 6, 3)]
    torch.manual_seed(99)
    assert float(pipeline.get_train_loss_dict(3)[1]["l1"].detach()) == first[1] == first[3]
    with mock.patch.object(pipeline.config.datamanager, "seed", 1), torch.random.fork_rng():
        index, frames = pipeline.datamanager.next_train(3)
        torch.manual_seed(5)
        assert float(pipeline.model.losses(index, frames)[1]["l1"].detach()) != first[3], "proves too little"
