"""Scenes are prepared while steps are taken, and that changes nothing but the time."""

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from unittest import mock

import pytest

from making import dense_config, equal
from pointsplat_ns.errors import DataError
from pointsplat_ns.io import read_ply, write_ply
from pointsplat_ns.nerfstudio_plugin.pointsplat import dense_scenes
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel
from pointsplat_ns.nerfstudio_plugin.pointsplat.preparation import Background
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refiner import Refiner

NAME = "background_0"
SECONDS = 120.0
"""How long a test waits for what shall come; it takes some seconds."""


def background_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == NAME]


@pytest.fixture(autouse=True)
def none_is_left():
    before = background_threads()  # of pipelines of other tests
    yield
    assert [thread for thread in background_threads() if thread not in before] == []


def called_before(function: Callable, before: Callable[[int], object]) -> Callable:
    """A function that calls another one, and before that ``before`` with the number of the call."""
    calls = []

    def called(*args, **options):
        calls.append(args)
        before(len(calls))
        return function(*args, **options)

    return called


def test_the_first_step_waits_for_no_scene_but_its_own(three_rooms, run_training, tmp_path):
    stepped, step = threading.Event(), PointSplatTrainer.one_step

    def wait(call: int) -> None:
        assert call == 1 or stepped.wait(SECONDS), "the first step has not come"

    def one_step(trainer, number):
        result = step(trainer, number)
        stepped.set()
        return result

    with (
        mock.patch.object(dense_scenes, "sample_views", called_before(dense_scenes.sample_views, wait)),
        mock.patch.object(PruneSettings, "prune", called_before(PruneSettings.prune, wait)),
        mock.patch.object(PointSplatTrainer, "one_step", one_step),
    ):
        trainer, losses = run_training(dense_config(three_rooms, tmp_path, 3))
    assert len(losses) == 3 and trainer.step == 2


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
    steps = []
    one_step = called_before(PointSplatTrainer.one_step, steps.append)
    with mock.patch.object(PointSplatTrainer, "one_step", one_step), pytest.raises(DataError, match=f"^{path}: "):
        run_training(config)
    assert len(steps) == 3


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
    assert end.value.code == status
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
    assert background.take(5, make(5)) == 2 and made[-1] == (5, threading.current_thread().name)
    background.start(3, make(3))
    background.stop()
    background.check()
    assert background.take(3, make(1)) == 10 and made[-1][1] != NAME
