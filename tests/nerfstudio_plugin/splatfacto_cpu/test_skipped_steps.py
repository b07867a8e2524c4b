"""Steps of splatfacto-cpu whose loss or gradients are not finite are skipped, counted and named."""

import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from making import equal
from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanager
from pointsplat_ns.nerfstudio_plugin.optimizers import all_finite
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModel

LOG = "pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.trainer.CONSOLE.log"


@contextmanager
def broken(kind: str, steps: range) -> Iterator[None]:
    """Within, these steps have a photo with one number that is none or infinite, or a gradient that is none."""
    next_train, losses_of = LazyImageDatamanager.next_train, SplatfactoCpuModel.get_loss_dict

    def photos(self, step):
        camera, data = next_train(self, step)
        if step in steps and kind != "gradient":
            image = data["image"].float() / 255
            image[5, 7] = {"nan": math.nan, "infinite": math.inf}[kind]
            data = {**data, "image": image}
        return camera, data

    def losses(self, *args, **kwargs):
        found = losses_of(self, *args, **kwargs)
        if self.step in steps and kind == "gradient":
            found["main_loss"] = found["main_loss"] + 0 * (0 * self.scales.sum()).sqrt()  # a root's slope at 0, times 0
            assert found["main_loss"].isfinite()
        return found

    with (
        mock.patch.object(LazyImageDatamanager, "next_train", photos),
        mock.patch.object(SplatfactoCpuModel, "get_loss_dict", losses),
    ):
        yield


def state_of(trainer):
    """Parameters, the optimisers' moments and what densification has gathered."""
    optimizers = {name: o.state_dict()["state"] for name, o in trainer.optimizers.optimizers.items()}
    model = trainer.pipeline.model
    parameters = {name: value.detach() for name, value in model.gauss_params.items()}
    return copy.deepcopy({"parameters": parameters, "moments": optimizers, "gathered": dict(model.strategy_state)})


@pytest.fixture()
def started(wall_scene, wall_config, tmp_path):
    """A trainer before its first step."""
    torch.manual_seed(0)
    config = wall_config(wall_scene, tmp_path, 20)
    config.early_look = False
    config.pipeline.model.warmup_length = 2  # densification in the eleventh step, before schedules are fitted
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def take(trainer, steps) -> list[dict]:
    """Take steps as nerfstudio's trainer does; the metrics of each."""
    found = []
    for step in steps:
        trainer.step = step
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        found.append(trainer.train_iteration(step)[2])
        for callback in trainer.callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    return found


@pytest.mark.parametrize(
    ("kind", "said"), [("nan", "the main_loss is nan"), ("gradient", "the gradient of the scales is not finite")]
)
def test_a_step_that_is_not_finite_changes_nothing_and_is_counted_and_named(started, kind, said):
    take(started, range(2))
    before = state_of(started)
    assert before["gathered"]["count"].any(), "densification has gathered something"
    with broken(kind, range(2, 3)), mock.patch(LOG) as log:
        (metrics,) = take(started, [2])
    assert equal(state_of(started), before)
    photo = started.pipeline.datamanager.latest_photo
    assert started.skipped == {photo: 1} and metrics["skipped_steps"] == 1 and photo.endswith((".png", ".jpg"))
    assert [call.args[0] for call in log.call_args_list] == [
        f"step 2 is skipped: {photo}: {said} (said once for each photo)"
    ]
    (metrics,) = take(started, [3])  # a sound one
    assert metrics["skipped_steps"] == 1 and not equal(state_of(started)["parameters"], before["parameters"])


def test_densification_comes_though_its_step_is_skipped(started):
    take(started, range(10))
    with broken("nan", range(10, 11)):
        take(started, [10])
    assert started.pipeline.model.num_points != 300
    take(started, [11])
    assert all_finite(state_of(started)["parameters"].values())


def test_one_broken_photo_stops_nothing_and_too_many_steps_in_a_row_stop_and_name_it(
    wall_scene, wall_config, run_training, tmp_path
):
    config = wall_config(wall_scene, tmp_path, 12)
    config.early_look, config.max_skipped_in_a_row = False, 2
    with broken("nan", range(3, 12, 2)):
        trainer, losses = run_training(config)
    assert trainer.skipped.total() == 5 and len(losses) == 12
    config.set_timestamp()
    message = r"stopped at step 7: .* in the last 3 steps, which were skipped \(.*: \d.*\); .*--load-dir .*"
    with broken("nan", range(5, 12)), pytest.raises(DataError, match=message) as caught:
        run_training(config)
    assert "\n" not in str(caught.value) and (config.get_checkpoint_dir() / "step-000000007.ckpt").is_file()
    config.max_skipped_in_a_row = -1
    with pytest.raises(PointSplatError, match="--max-skipped-in-a-row -1: expected at least 0"):
        config.setup(local_rank=0, world_size=1).setup()


def test_a_gradient_whose_sum_overflows_is_finite():
    large = torch.full((4,), 3e38)
    assert not large.sum().isfinite() and all_finite([large, torch.zeros(2)])
    assert not all_finite([large, torch.tensor([0.0, math.nan])])
    assert not all_finite([torch.tensor([math.inf, -1.0])]) and all_finite([])
