"""Interrupted trainings, skipped steps, and numbers below the smallest normal float."""

import copy
import os
import signal
import threading
from unittest import mock

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import launch

from broken_steps import broken
from making import equal, small_config
from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import (
    SplatfactoCpuTrainer,
    splatfacto_cpu_config,
)
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModel
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.trainer import takes_tiny_as_zero
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.runs import open_run


@pytest.fixture(autouse=True)
def heeded():
    """Where the tests run in the background of a shell, SIGINT is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def stopped_at(step: int, config, run_training, monkeypatch, number: int, times: int = 1) -> int:
    """The status with which a training ends that gets a signal in the middle of a step."""
    update = SplatfactoCpuTrainer.update

    def signalled(trainer, now, skipped):
        if now == step:
            for _ in range(times):
                os.kill(os.getpid(), number)
        update(trainer, now, skipped)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(SplatfactoCpuTrainer, "update", signalled)
        run_training(config)
    return end.value.code


def test_a_training_that_is_stopped_leaves_a_scene_and_can_be_gone_on_with(
    wall_scene, wall_config, run_training, monkeypatch, tmp_path, capsys
):
    config = wall_config(wall_scene, tmp_path, steps=30)
    # Step 10 densifies, which is not to be interrupted.
    assert stopped_at(10, config, run_training, monkeypatch, signal.SIGTERM) == 143
    said = capsys.readouterr()
    assert "stopping after this step" in said.err and said.err.endswith("interrupted\n")
    run = open_run(config.get_base_dir())
    assert run.step == 10 and "Saved after step 10" in said.out
    scene = read_scene(run.folder)
    assert (
        len({len(value) for value in scene.tensors()}) == 1
        and scene.usable().all()
        and len(scene) > 100
    )
    again = wall_config(wall_scene, tmp_path, steps=3)
    # In the same second it would have the same folder.
    again.load_dir = config.get_checkpoint_dir()
    again.timestamp = "2031-01-01_000000"
    trainer, _ = run_training(again)
    assert trainer._start_step == 11 and trainer.step == 13
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_ctrl_c_before_the_first_step_ends_the_command_as_interrupted(monkeypatch, capsys):
    def main(**_):
        trainer = object.__new__(SplatfactoCpuTrainer)
        trainer.config = splatfacto_cpu_config()
        trainer.device = "cpu"
        trainer.world_size = 1
        trainer.setup()

    monkeypatch.setattr(Trainer, "setup", mock.Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(SystemExit) as end:
        launch(main, num_devices_per_machine=1, config=splatfacto_cpu_config(), device_type="cpu")
    assert end.value.code == 130 and capsys.readouterr().err.endswith("interrupted\n")


def test_a_second_or_early_signal_ends_it_at_once_and_saves_nothing(
    wall_scene, wall_config, run_training, monkeypatch, tmp_path
):
    config = wall_config(wall_scene, tmp_path, steps=30)
    assert stopped_at(3, config, run_training, monkeypatch, signal.SIGINT, times=2) == 130
    assert not list(config.get_checkpoint_dir().glob("*"))
    early = wall_config(wall_scene, tmp_path / "early", steps=30)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(SplatfactoCpuTrainer, "_asked", signal.SIGINT)
        run_training(early)
    assert end.value.code == 130 and not early.get_checkpoint_dir().exists()


@pytest.mark.parametrize("number", [0, -3])
def test_no_steps_are_refused_and_leave_no_folder(number, wall_scene, wall_config, tmp_path):
    for config in (
        wall_config(wall_scene, tmp_path / "scene", 2),
        small_config(wall_scene, tmp_path / "refiner", 2),
    ):
        config.max_num_iterations = number
        config.load_dir = tmp_path / "checkpoints"
        with pytest.raises(
            PointSplatError, match=f"--max-num-iterations {number}: expected at least 1"
        ):
            config.set_timestamp()
        assert not config.output_dir.exists()


def state_of(trainer):
    moments = trainer.optimizers.optimizers
    model = trainer.pipeline.model
    state = {
        "moments": {name: optimizer.state_dict()["state"] for name, optimizer in moments.items()}
    }
    return copy.deepcopy(
        {**state, "parameters": model.state_dict(), "gathered": dict(model.strategy_state)}
    )


@pytest.fixture()
def started(wall_scene, wall_config, tmp_path):
    torch.manual_seed(0)
    config = wall_config(wall_scene, tmp_path, 20)
    config.pipeline.model.warmup_length = (
        2  # densification in the eleventh step, before schedules are fitted
    )
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def take(trainer, steps) -> list[dict]:
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
    ("kind", "said"),
    [
        ("nan", "the loss main_loss is nan"),
        ("gradient", "the gradient of the scales is not finite"),
    ],
)
def test_a_step_that_is_not_finite_changes_nothing_and_is_named(started, kind, said):
    take(started, range(2))
    before = state_of(started)
    assert before["gathered"]["count"].any(), "densification has gathered something"
    with (
        broken(kind, range(2, 3)),
        mock.patch("pointsplat_ns.nerfstudio_plugin.console.CONSOLE.log") as log,
    ):
        (metrics,) = take(started, [2])
    assert equal(state_of(started), before)
    photo = started.pipeline.datamanager.latest_photo
    assert (
        started.skipped == {photo: 1}
        and metrics["skipped_steps"] == 1
        and photo.endswith((".png", ".jpg"))
    )
    assert [call.args[0] for call in log.call_args_list] == [
        f"step 2 is skipped: {photo}: {said} (said once for each)"
    ]
    (metrics,) = take(started, [3])  # a sound one
    assert metrics["skipped_steps"] == 1 and not equal(
        state_of(started)["parameters"], before["parameters"]
    )


def test_many_broken_steps_in_a_row_stop_a_training_and_few_do_not(
    wall_scene, wall_config, run_training, monkeypatch, tmp_path
):
    monkeypatch.setattr("pointsplat_ns.nerfstudio_plugin.trainer.MOST_SKIPPED_IN_A_ROW", 2)
    config = wall_config(wall_scene, tmp_path, 12)
    with broken("nan", range(3, 12, 2)):
        trainer, losses = run_training(config)
    assert trainer.skipped.total() == 5 and len(losses) == 12
    config.set_timestamp()
    message = r"stopped at step 7: .* in the last 3 steps, which were skipped \(.*: \d.*\); .*--load-dir .*"
    with broken("nan", range(5, 12)), pytest.raises(DataError, match=message):
        run_training(config)
    assert (config.get_checkpoint_dir() / "step-000000007.ckpt").is_file()


def test_a_training_and_its_threads_alone_take_tiny_numbers_as_zero(started, monkeypatch):
    found = []
    losses_of = SplatfactoCpuModel.get_loss_dict

    def losses(self, *args, **kwargs):
        thread = threading.Thread(target=lambda: found.append(takes_tiny_as_zero()))
        thread.start()
        thread.join()
        found.append(takes_tiny_as_zero())
        return losses_of(self, *args, **kwargs) if len(found) < 3 else 1 / 0

    monkeypatch.setattr(SplatfactoCpuModel, "get_loss_dict", losses)
    assert not takes_tiny_as_zero()
    with pytest.raises(ZeroDivisionError):
        started.train()
    assert set(found) == {torch.set_flush_denormal(False)} and not takes_tiny_as_zero()
