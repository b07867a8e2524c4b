"""Scenes are prepared while steps are taken, and that changes nothing but the time."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from unittest import mock

import pytest

from making import dense_config, equal
from pointsplat_ns.errors import DataError
from pointsplat_ns.io import read_ply, write_ply
from pointsplat_ns.nerfstudio_plugin.pointsplat import dense_scenes
from pointsplat_ns.nerfstudio_plugin.pointsplat.background import NAME, Background
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refiner import Refiner

SECONDS = 120.0
"""How long a test waits for what shall come; it takes some seconds."""


def background_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == NAME]


@pytest.fixture(autouse=True)
def none_of_other_tests():
    deadline = time.monotonic() + SECONDS
    while background_threads() and time.monotonic() < deadline:
        time.sleep(0.01)


@contextmanager
def after_the_first(owner: object, name: str, before: Callable[[], object]):
    """Let every call of a function but the first do something before."""
    function, calls = getattr(owner, name), []

    def called(*args, **options):
        calls.append(args)
        if len(calls) > 1:
            before()
        return function(*args, **options)

    with mock.patch.object(owner, name, called):
        yield


def test_the_first_step_waits_for_no_scene_but_its_own(three_rooms, run_training, tmp_path):
    stepped = threading.Event()

    def wait():
        assert stepped.wait(SECONDS), "the first step has not come"

    step = PointSplatTrainer.one_step

    def one_step(trainer, number):
        result = step(trainer, number)
        stepped.set()
        return result

    with (
        after_the_first(dense_scenes, "sample_views", wait),
        after_the_first(PruneSettings, "prune", wait),
        mock.patch.object(PointSplatTrainer, "one_step", one_step),
    ):
        trainer, losses = run_training(dense_config(three_rooms, tmp_path, 3))
    assert len(losses) == 3 and trainer.step == 2 and not background_threads()


def test_the_next_scenes_are_prepared_while_a_step_is_taken(three_rooms, run_training, tmp_path):
    pruned, three, losses = [], threading.Event(), PointSplatModel.losses
    prune = PruneSettings.prune

    def counted(settings, scene, progress=None):
        result = prune(settings, scene, progress)
        pruned.append(threading.current_thread().name)
        if len(pruned) == 3:
            three.set()
        return result

    def slow(model, index, frames):
        if model.training:
            assert three.wait(SECONDS), "the others were not prepared in the first step"
        return losses(model, index, frames)

    with mock.patch.object(PruneSettings, "prune", counted), mock.patch.object(PointSplatModel, "losses", slow):
        run_training(dense_config(three_rooms, tmp_path, 2))
    assert pruned == [NAME] * 3


def test_losses_do_not_depend_on_when_scenes_are_prepared(three_rooms, run_training, tmp_path):
    def trained(name: str, gigabytes: float | None = None):
        config = dense_config(three_rooms, tmp_path / name, 7)
        config.pipeline.model.more_keeps = (0.3,)
        config.pipeline.datamanager.cache_gigabytes = gigabytes
        trainer, losses = run_training(config)
        return losses, trainer.pipeline.model.refiner.state_dict()

    prune, prepare, picture = PruneSettings.prune, Refiner.prepare, DenseScene.picture
    threads = {"prune": set(), "tables": set(), "picture": set()}

    def recorded(name, function, delay=0.0):
        def called(*args):
            threads[name].add(threading.current_thread().name)
            time.sleep(delay)
            return function(*args)

        return called

    expected = trained("ahead")
    with (
        mock.patch.object(PruneSettings, "prune", recorded("prune", prune, delay=0.5)),
        mock.patch.object(Refiner, "prepare", recorded("tables", prepare)),
        mock.patch.object(DenseScene, "picture", recorded("picture", picture)),
    ):
        late = trained("late")
        # What a GPU may do is done by the thread that trains; the budget of each step is known ahead.
        main = {threading.current_thread().name}
        assert threads == {"prune": {NAME}, "tables": main, "picture": main}
    with mock.patch.object(Background, "start", lambda *_: None):
        at_once = trained("at once")
    for losses, weights in (late, at_once, trained("no memory", 0.0)):
        assert losses == expected[0] and equal(weights, expected[1])


def test_a_scene_that_cannot_be_used_ends_the_training_at_its_turn(three_rooms, run_training, tmp_path):
    shutil.copytree(three_rooms, tmp_path / "rooms")
    config = dense_config(tmp_path / "rooms", tmp_path / "outputs", 3)
    order = [config.pipeline.setup(device="cpu").datamanager.scene_at(step) for step in range(3)]
    path = tmp_path / "rooms" / f"room{order[-1]}.ply"
    scene = read_ply(path)
    scene.means.fill_(float("nan"))
    path.unlink()
    write_ply(scene, path)
    trainer, steps = None, []
    step = PointSplatTrainer.one_step

    def one_step(self, number):
        nonlocal trainer
        trainer = self
        result = step(self, number)
        steps.append(number)
        return result

    with mock.patch.object(PointSplatTrainer, "one_step", one_step), pytest.raises(DataError, match=f"^{path}: "):
        run_training(config)
    assert steps == [0, 1] and not background_threads()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_preparation_too(number, status, three_rooms, run_training, tmp_path):
    config, losses = dense_config(three_rooms, tmp_path, 3), PointSplatModel.losses
    begun, prune = threading.Event(), PruneSettings.prune
    pruned = []

    def endless(settings, scene, progress=None):
        pruned.append(scene)
        if len(pruned) == 1:
            return prune(settings, scene, progress)
        begun.set()
        deadline = time.monotonic() + SECONDS
        while time.monotonic() < deadline:
            progress(0.5)
            time.sleep(0.01)
        pytest.fail("it was not stopped")

    def signalled(model, index, frames):
        assert begun.wait(SECONDS)
        os.kill(os.getpid(), number)
        return losses(model, index, frames)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background of a shell it is ignored
    try:
        with (
            mock.patch.object(PruneSettings, "prune", endless),
            mock.patch.object(PointSplatModel, "losses", signalled),
            pytest.raises(SystemExit) as end,
        ):
            run_training(config)
    finally:
        signal.signal(signal.SIGINT, before)
    assert end.value.code == status and not background_threads()
    assert [path.name for path in config.get_checkpoint_dir().iterdir()] == ["step-000000000.ckpt"]


def test_values_come_in_order_once_with_their_errors_and_none_after_a_stop():
    background, made = Background(), []

    def make(value: int) -> Callable[[], int]:
        def made_now() -> int:
            made.append((value, threading.current_thread().name))
            return 10 // value

        return made_now

    for value in (5, 0, 5, 2):
        background.start(value, make(value))
    assert background.take(2, make(2)) == 5 and background.take(5, make(5)) == 2
    assert made == [(5, NAME), (0, NAME), (2, NAME)]
    with pytest.raises(ZeroDivisionError):
        background.take(0, make(0))
    for thread in background_threads():  # there is nothing left to make
        thread.join(SECONDS)
    assert not background_threads()
    assert background.take(5, make(5)) == 2 and made[-1] == (5, threading.current_thread().name)

    running = threading.Event()

    def long() -> None:
        running.set()
        while True:
            background.check()
            time.sleep(0.01)

    background.start("long", long)
    background.start("next", make(1))
    assert running.wait(SECONDS)
    background.stop()
    assert not background_threads() and made[-1][0] == 5
    background.check()
    assert background.take("next", make(1)) == 10


def test_a_program_ends_while_something_is_being_made():
    words = """
import time
from pointsplat_ns.nerfstudio_plugin.pointsplat.background import Background
background = Background()
def long():
    while True:
        background.check()
        time.sleep(0.01)
background.start("long", long)
time.sleep(0.1)
"""
    ended = subprocess.run([sys.executable, "-c", words], capture_output=True, timeout=SECONDS, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")
