"""Trainings of the refiner: what is saved, skipped steps, targets, budgets and transforms."""

import copy
import json
import shutil
from pathlib import Path
from unittest import mock

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from broken_steps import broken
from making import dense_config, equal, move_zero_layers, small_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import REFINER_RATES
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import MODEL_METADATA
from pointsplat_ns.refinement import read_refiner
from pointsplat_ns.refinement.weights import read_metadata
from pointsplat_ns.scene.runs import RUN_FILES

pytestmark = pytest.mark.usefixtures("quick")


def test_the_checkpoint_holds_the_network_and_nothing_else(trained):
    config, trainer = trained
    (path,) = config.get_checkpoint_dir().iterdir()
    state = torch.load(path, map_location="cpu", weights_only=True)
    refiner = trainer.pipeline.model.refiner
    assert [name.split("/")[0] for name in state["pipeline"].pop("_extra_state")["trained_on"]] == [
        "wall-a"
    ]
    wanted = {f"_model.refiner.{name}": value for name, value in refiner.state_dict().items()}
    assert equal(state["pipeline"], {**wanted, "_model.device_indicator_param": torch.empty(0)})
    parameters = sum(p.numel() for p in refiner.parameters())
    assert path.stat().st_size < 4 * 3 * parameters + 500_000, (
        "three floats a parameter: itself and Adam's two"
    )
    assert set(state["optimizers"]) == set(REFINER_RATES)
    trained_numbers = {
        p
        for g in trainer.optimizers.optimizers.values()
        for s in g.param_groups
        for p in s["params"]
    }
    assert trained_numbers == set(refiner.parameters()), "every parameter has a learning rate"


def test_the_network_is_saved_by_itself_at_the_end(trained):
    config, trainer = trained
    path = config.get_base_dir() / RUN_FILES.refiner
    assert equal(read_refiner(path).state_dict(), trainer.pipeline.model.refiner.state_dict())
    about = read_metadata(path)
    model = {name: getattr(config.pipeline.model, name) for name in MODEL_METADATA}
    assert {name: about[name] for name in model} == model and about["more_keeps"] == []
    assert (about["steps"], about["scenes"], about["keep"], about["by"]) == (
        10,
        "wall-a",
        0.5,
        "paper",
    )
    assert (about["supervision"], about["rate_factor"]) == ("photos", config.rate_factor)
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000009.ckpt"]


def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(three_rooms, tmp_path):
    config = dense_config(three_rooms, tmp_path, 4)
    config.pipeline.model.norm = "batch"  # has running statistics
    trainer = config.setup(local_rank=0, world_size=1)
    history = []
    with (
        broken("nan", {1}),
        mock.patch("pointsplat_ns.nerfstudio_plugin.console.CONSOLE.log") as log,
    ):
        trainer.setup()
        for step in range(3):
            _, _, metrics = trainer.pipeline.train() and trainer.train_iteration(step)
            moments = {
                name: adam.state_dict()["state"]
                for name, adam in trainer.optimizers.optimizers.items()
            }
            history.append(
                copy.deepcopy((trainer.pipeline.model.refiner.state_dict(), moments, metrics))
            )
    weights, states, metrics = zip(*history, strict=True)
    assert equal(weights[1], weights[0]) and equal(states[1], states[0])
    moved = [name for name in weights[0] if not torch.equal(weights[2][name], weights[1][name])]
    assert any("running" in name for name in moved) and any("heads" in name for name in moved)
    manager = trainer.pipeline.datamanager
    scene = manager.scenes[manager.scene_at(1)].name
    assert trainer.skipped == {scene: 1} and [m["skipped_steps"] for m in metrics] == [0, 1, 1]
    text = f"step 1 is skipped: {scene}: the loss l1 is nan (said once for each)"
    assert [call.args[0] for call in log.call_args_list if "skipped" in call.args[0]] == [text]
    assert all(schedule.last_epoch == 3 for schedule in trainer.optimizers.schedulers.values()), (
        "it counts steps"
    )


def test_losses_do_not_depend_on_what_stays_in_memory(three_rooms, run_training, tmp_path):
    results = []
    for gigabytes in (None, 0.0):
        config = dense_config(three_rooms, tmp_path / str(gigabytes), 7)
        config.pipeline.model.more_keeps = (0.3,)
        config.pipeline.datamanager.cache_gigabytes = gigabytes
        trainer, losses = run_training(config)
        results.append({"losses": losses, **trainer.pipeline.model.refiner.state_dict()})
    assert equal(*results)


@pytest.fixture(scope="module")
def trained_on_rooms(three_rooms, run_training, tmp_path_factory):
    config = dense_config(three_rooms, tmp_path_factory.mktemp("refined"), steps=16)
    config.rate_factor = 10.0
    config.pipeline.datamanager.eval_scenes = ("room2",)
    trainer, _ = run_training(config)
    return config, trainer


def test_a_folder_of_ply_files_trains_the_refiner(trained_on_rooms, no_lpips):
    config, trainer = trained_on_rooms
    pipeline = trainer.pipeline
    report = pipeline.get_average_eval_image_metrics()
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert report["supervision"] == "dense" and report["reference"] == "dense renders"
    for name, block in report["scenes"].items():
        assert block["reference"] == "dense renders" and block["views"] == 1
        assert block["seen_in_training"] == (name != "room2")
        assert block["dense"]["psnr"] is None or block["dense"]["psnr"] > 100, (
            "it is the reference: float32 noise"
        )
        # dB; 16 steps give the training scenes 1.5 or more
        assert block["refined"]["psnr"] > block["pruned"]["psnr"] + (
            0.5 if name != "room2" else 0.0
        )
    opened = eval_setup(config.get_base_dir() / "config.yml")[1].get_average_eval_image_metrics()
    assert (
        opened["psnr"] == report["psnr"] and opened["scenes"]["room2"]["seen_in_training"] is False
    )


def test_no_mean_mixes_photos_and_dense_renders(
    trained_walls, three_rooms, tmp_path, no_lpips, capsys
):
    shutil.copytree(trained_walls, tmp_path / "all")
    shutil.copy(three_rooms / "room0.ply", tmp_path / "all")
    config = dense_config(tmp_path / "all", tmp_path, 1)
    config.pipeline.datamanager.supervision = "dense"
    report = (
        config.pipeline.setup(device="cpu", test_mode="test")
        .eval()
        .get_average_eval_image_metrics(get_std=True)
    )
    json.dumps(report, allow_nan=False)
    scenes = report["scenes"]
    references = {name: block["reference"] for name, block in scenes.items()}
    assert references == {"wall-a": "photos", "wall-b": "photos", "room0": "dense renders"}
    walls = [scenes[name]["refined"]["psnr"] for name in ("wall-a", "wall-b")]
    assert report["reference"] == "photos" and report["psnr"] == pytest.approx(sum(walls) / 2)
    assert report["average"]["refined"]["psnr"] == report["psnr"]
    said = capsys.readouterr().out
    assert (
        "compared with photos" in said
        and "compared with dense renders, and in no mean: room0\n" in said
    )


def test_the_loss_is_against_the_dense_scene_even_where_there_are_photos(trained_walls):
    config = dense_config(trained_walls, Path("unused"), 1)
    config.pipeline.model.keep = 1.0
    losses = {}
    for supervision in ("photos", "dense"):
        config.pipeline.datamanager.supervision = supervision
        pipeline = config.pipeline.setup(device="cpu", test_mode="val")
        losses[supervision] = float(pipeline.get_train_loss_dict(0)[1]["l1"].detach())
    # an untrained refiner that keeps all is the dense scene, but for the rounding of its renders to
    # 8 bits
    assert losses["dense"] < 0.5 / 255 and losses["photos"] > 5 / 255


def test_one_network_learns_at_several_budgets_and_shows_the_first(trained_walls, tmp_path):
    config = small_config(trained_walls, tmp_path, 12, more_keeps=(0.25, 40.0))
    pipeline = config.pipeline.setup(device="cpu", test_mode="val").train()
    model = pipeline.model
    cache = pipeline.datamanager.cache

    for step in range(
        12
    ):  # by chance one of three is not met in one of 40 seeds; the seed is fixed
        pipeline.get_train_loss_dict(step)
    for keep in (0.5, 0.25, 40.0):
        assert any(
            cache.get(("pruned", s.name, model.config.prune_settings(keep))) for s in model.scenes
        )
    assert len(model.eval().refine(0)) == round(0.5 * len(model.scenes[0].read_dense()))


def test_steps_draw_different_random_numbers_and_a_step_always_the_same(trained_walls, tmp_path):
    """What augmentation, backgrounds and budgets are drawn from."""
    pipeline = small_config(trained_walls, tmp_path, 3).pipeline.setup(
        device="cpu", test_mode="val"
    )
    pipeline.train()
    drawn = {}

    def losses(index, frames):
        drawn.setdefault(step, []).append(float(torch.rand(())))
        return {}, {}, {}

    pipeline.model.losses = losses
    for step in (0, 1, 2, 3, 2, 0):
        pipeline.get_train_loss_dict(step)
    assert len({values[0] for values in drawn.values()}) == 4
    assert all(len(set(values)) == 1 for values in drawn.values())


def test_transforms_change_what_the_network_sees_and_nothing_else(trained_walls, tmp_path):
    def losses(augment: bool) -> list[float]:
        config = small_config(trained_walls, tmp_path, 3, augment=augment)
        pipeline = config.pipeline.setup(device="cpu", test_mode="val").train()
        zero = float(pipeline.get_train_loss_dict(1)[1]["l1"].detach())
        torch.manual_seed(3)
        move_zero_layers(pipeline.model.refiner)
        return [zero, float(pipeline.get_train_loss_dict(1)[1]["l1"].detach())]

    plain = losses(False)
    moved = losses(True)
    again = losses(True)
    # Residuals are zero at the beginning. Undoing a transform rounds: thresholds flip in few
    # pixels.
    assert moved[0] == pytest.approx(plain[0], rel=1e-4)
    assert moved[1] != plain[1]
    assert moved == again, "the same seed draws the same transforms"
