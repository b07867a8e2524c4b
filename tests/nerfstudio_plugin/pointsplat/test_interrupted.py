"""Trainings of the refiner that a signal ends: at loading, in steps, while results are written, and
in the report."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from nerfstudio.scripts.train import launch, train_loop

from making import fast_config
from pointsplat_ns.nerfstudio_plugin.pointsplat import pipeline as module
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import PointSplatTrainerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManager
from pointsplat_ns.nerfstudio_plugin.pointsplat.progress import Progress
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer
from pointsplat_ns.pipeline.trained_refiner import load_refiner
from pointsplat_ns.scene.checkpoints import read_training_state

pytestmark = pytest.mark.usefixtures("quick")

STEPS = 3


@pytest.fixture(autouse=True)
def heeded():
    """Where the tests run in the background of a shell, SIGINT is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def signalled(
    monkeypatch, owner: object, name: str, number: int, when: Callable[..., bool]
) -> None:
    """Let a function begin with a signal to this process, the first time that ``when`` is true of
    its arguments."""
    usual = getattr(owner, name)
    sent = []

    def with_signal(*arguments, **options):
        if not sent and when(*arguments):
            sent.append(number)
            os.kill(os.getpid(), number)
        return usual(*arguments, **options)

    monkeypatch.setattr(owner, name, with_signal)


def status_of(config: PointSplatTrainerConfig) -> int:
    """The status with which ns-train ends."""
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.save_config()
    with pytest.raises(SystemExit) as end:
        launch(train_loop, num_devices_per_machine=1, config=config, device_type="cpu")
    return end.value.code


def files_of(config: PointSplatTrainerConfig) -> list[Path]:
    return [path for path in config.output_dir.rglob("*") if path.is_file()]


def always(*arguments) -> bool:
    return True


AT = {
    "loading": (ScenesDataManager, "__init__", always),
    "the first measurement": (Progress, "measure", always),
    "a step": (PointSplatTrainer, "update", lambda trainer, step, skipped: step == 1),
    "the last step": (PointSplatTrainer, "update", lambda trainer, step, skipped: step == 2),
    "the checkpoint": (torch, "save", always),
    "the network's file": (module, "save_refiner", always),
    "the report": (Progress, "measure", lambda progress, done: done == STEPS),
    "the pictures": (PointSplatTrainer, "draw", always),
}
"""Functions that a signal interrupts."""

NO_STEP = ("loading", "the first measurement")


@pytest.mark.parametrize("moment", AT)
def test_a_signal_loses_no_step_leaves_no_half_file_and_prints_no_traceback(
    moment, trained_walls, tmp_path, monkeypatch, capfd
):
    number = signal.SIGTERM if list(AT).index(moment) % 2 else signal.SIGINT
    config = fast_config(trained_walls, tmp_path, steps=STEPS)
    config.steps_per_eval_image = 100
    signalled(monkeypatch, *AT[moment][:2], number, AT[moment][2])
    assert status_of(config) == 128 + number
    said = capfd.readouterr()
    assert "Traceback" not in said.err + said.out and said.err.endswith("interrupted\n")
    files = files_of(config)
    assert not [path for path in files if ".part" in path.name]
    if moment in NO_STEP:
        assert files == [] and not config.output_dir.joinpath("refiner").exists()
        return
    (checkpoint,) = config.get_checkpoint_dir().iterdir()
    done = 1 if moment == "a step" else STEPS - 1
    assert read_training_state(checkpoint)["step"] == done
    assert f"step-{done:09d}.ckpt" == checkpoint.name
    load_refiner(config.get_base_dir())  # from its file, or from the checkpoint
