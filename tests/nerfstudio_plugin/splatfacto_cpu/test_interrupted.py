"""Ctrl-C in ``ns-train``."""

import os
import signal

import pytest
import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import launch

from making import box_room, dense_config
from pointsplat_ns.io import open_run, read_scene, write_ply
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import SplatfactoCpuTrainer, splatfacto_cpu_config

LATER = "2031-01-01_000000"
"""When a training goes on that began a moment ago: in the same second it would have the same folder."""


@pytest.fixture(autouse=True)
def heeded():
    """Where the tests run in the background of a shell, SIGINT is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def stopped_at(
    step: int, config, run_training, monkeypatch, number: int, times: int = 1, trainer_class=SplatfactoCpuTrainer
) -> int:
    """The status with which a training ends that gets a signal in the middle of a step."""
    iteration = trainer_class.train_iteration

    def signalled(trainer, now):
        if now == step:
            for _ in range(times):
                os.kill(os.getpid(), number)
        return iteration(trainer, now)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(trainer_class, "train_iteration", signalled)
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
    assert len({len(value) for value in scene.tensors()}) == 1 and scene.usable().all() and len(scene) > 100
    again = wall_config(wall_scene, tmp_path, steps=3)
    again.load_dir, again.timestamp = config.get_checkpoint_dir(), LATER
    trainer, _ = run_training(again)
    assert trainer._start_step == 11 and trainer.step == 13
    state = torch.load(run.checkpoint, weights_only=True)
    assert state["step"] == 10
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_training_of_a_refiner_stops_in_the_same_way(run_training, monkeypatch, tmp_path, no_lpips):
    write_ply(box_room(1), tmp_path / "rooms" / "one.ply")
    config = dense_config(tmp_path / "rooms", tmp_path, steps=5)
    status = stopped_at(2, config, run_training, monkeypatch, signal.SIGINT, trainer_class=PointSplatTrainer)
    assert status == 130 and open_run(config.get_base_dir()).step == 2
    again = dense_config(tmp_path / "rooms", tmp_path, steps=1)
    again.load_dir, again.timestamp = config.get_checkpoint_dir(), LATER
    assert run_training(again)[0]._start_step == 3


@pytest.mark.parametrize("kind", [SplatfactoCpuTrainer, PointSplatTrainer])
def test_ctrl_c_before_the_first_step_ends_nerfstudios_command_as_interrupted(kind, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    def main(**_):
        trainer = object.__new__(kind)
        trainer.config, trainer.device, trainer.world_size = splatfacto_cpu_config(), "cpu", 1
        trainer.setup()

    monkeypatch.setattr(Trainer, "setup", interrupted)
    with pytest.raises(SystemExit) as end:
        launch(main, num_devices_per_machine=1, config=splatfacto_cpu_config(), device_type="cpu")
    assert end.value.code == 130 and capsys.readouterr().err.endswith("interrupted\n")


def test_a_second_signal_and_one_before_the_first_step_end_it_at_once_and_save_nothing(
    wall_scene, wall_config, run_training, monkeypatch, tmp_path
):
    config = wall_config(wall_scene, tmp_path, steps=30)
    assert stopped_at(3, config, run_training, monkeypatch, signal.SIGINT, times=2) == 130
    assert not list(config.get_checkpoint_dir().glob("*"))
    early = wall_config(wall_scene, tmp_path / "early", steps=30)
    stop = SplatfactoCpuTrainer._stop_if_asked

    def asked(trainer, step):
        trainer._asked = signal.SIGINT
        stop(trainer, step)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(SplatfactoCpuTrainer, "_stop_if_asked", asked)
        run_training(early)
    assert end.value.code == 130 and not early.get_checkpoint_dir().exists()


@pytest.mark.parametrize("asked, waits", [(None, True), (signal.SIGINT, False)])
def test_a_training_that_was_asked_to_stop_in_its_last_step_does_not_keep_its_viewer_open(asked, waits, monkeypatch):
    waited = []
    monkeypatch.setattr(Trainer, "_train_complete_viewer", lambda trainer: waited.append(trainer))
    trainer = object.__new__(SplatfactoCpuTrainer)
    trainer._asked = asked
    trainer._train_complete_viewer()
    assert (waited == [trainer]) == waits
