"""Training with nerfstudio's trainer: checkpoints, resuming, learning rates."""

from pathlib import Path
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import fast_config, pipeline_of
from pointsplat_ns.io.runs import RUN_FILES
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import REFINER_RATES
from pointsplat_ns.refiner import read_refiner
from pointsplat_ns.refiner.weights import read_metadata


def view_loss(model, manager, index: int) -> float:
    with torch.no_grad():
        _, losses, _ = model.losses(index, [f for f in manager.scenes[index].train_frames])
    return float(losses["l1"])


def test_training_lowers_the_loss_on_all_views(trained, trained_walls):
    _, trainer, _ = trained
    untrained = pipeline_of(trained_walls)
    model = trainer.pipeline.eval().model
    before = view_loss(untrained.model, untrained.datamanager, 0)
    assert view_loss(model, trainer.pipeline.datamanager, 0) < 0.95 * before


def test_the_held_out_scene_is_never_trained_on(trained):
    _, trainer, used = trained
    assert {index for training, index in used if training} == {0}
    assert len([1 for training, _ in used if training]) == 10
    assert trainer.pipeline.model.shown == 1


def test_the_checkpoint_holds_the_network_and_nothing_else(trained):
    config, trainer, _ = trained
    (path,) = config.get_checkpoint_dir().iterdir()
    state = torch.load(path, map_location="cpu", weights_only=True)
    refiner = trainer.pipeline.model.refiner
    names = {f"_model.refiner.{name}" for name in refiner.state_dict()}
    assert set(state["pipeline"]) == names | {"_model.device_indicator_param", "_extra_state"}
    assert [name.split("/")[0] for name in state["pipeline"]["_extra_state"]["trained_on"]] == ["wall-a"]
    assert all(torch.equal(state["pipeline"][f"_model.refiner.{n}"], v) for n, v in refiner.state_dict().items())
    parameters = sum(p.numel() for p in refiner.parameters())
    assert path.stat().st_size < 4 * 3 * parameters + 500_000, "three floats a parameter: itself and Adam's two"
    assert set(state["optimizers"]) == set(REFINER_RATES)
    trained_numbers = {p for g in trainer.optimizers.optimizers.values() for s in g.param_groups for p in s["params"]}
    assert trained_numbers == set(refiner.parameters()), "every parameter has a learning rate"


def test_the_network_is_saved_by_itself_at_the_end(trained):
    config, trainer, _ = trained
    path = config.get_base_dir() / RUN_FILES.refiner
    loaded = read_refiner(path).state_dict()
    expected = trainer.pipeline.model.refiner.state_dict()
    assert loaded.keys() == expected.keys() and all(torch.equal(loaded[n], v) for n, v in expected.items())
    about = {"step": "9", "scenes": "wall-a", "keep": "0.5", "by": "paper", "opacity_weight": None}
    assert read_metadata(path) == about
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000009.ckpt"]


def test_an_evaluation_while_training_is_logged(trained):
    _, trainer, _ = trained
    trainer.pipeline.train()
    metrics, images = trainer.pipeline.get_eval_image_metrics_and_images(step=4)
    assert {"psnr_pruned", "psnr_refined", "ssim_refined", "num_rays"} <= metrics.keys()
    assert images["photo_pruned_refined"].shape == (48, 3 * 64, 3)
    assert trainer.pipeline.training and trainer.pipeline.model.training, "training goes on as it was"


@pytest.mark.parametrize("steps", [1, 2, 3, 2000])
def test_learning_rates_rise_fall_and_never_rise_again(steps):
    config = fast_config(Path("unused"), Path("unused"), steps=steps)
    schedule = config.optimizers["encoder"]["scheduler"]
    with mock.patch.object(config, "_target", lambda fitted, **_: fitted):
        fitted = config.setup().optimizers["encoder"]["scheduler"]
    assert schedule.max_steps == 0, "the config itself, which is saved, is left alone"
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    scheduler = fitted.setup().get_scheduler(optimizer, 1.0)
    rates = []
    for _ in range(steps + 1):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step(), scheduler.step()
    peak = max(range(len(rates)), key=rates.__getitem__)
    assert rates[peak] == 1.0 and peak == max(1, round(0.05 * steps))
    assert all(a >= b for a, b in zip(rates[peak:], rates[peak + 1 :], strict=False))
    assert rates[-1] == pytest.approx(0.02) or steps == 1
