"""nerfstudio's commands, started in this process, and runs of our methods that ``ns-train`` trained."""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
from nerfstudio.scripts import train
from nerfstudio.utils import writer
from nerfstudio.viewer.viewer import Viewer

from captures import Capture
from ns_viewer import Look, look
from pointsplat_ns.nerfstudio_plugin.stopping import StoppableTrainer

METHODS = ("splatfacto-cpu", "pointsplat")
STEPS = {"splatfacto-cpu": 20, "pointsplat": 4}
LOOKED_AT = 2
"""Step after which the viewer is looked at."""


VIEWER = ("--viewer.websocket-host", "127.0.0.1", "--viewer.image-format", "png")
"""Options of commands that open the viewer, so that its pictures are those that the model draws."""


def started(program: ModuleType, *words: object) -> None:
    """Start one of nerfstudio's commands in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [program.__name__, *map(str, words)])
        patch.setattr(writer, "EVENT_WRITERS", [])  # those of trainings before in this process
        program.entrypoint()


@dataclass
class Run:
    """A method, a run of it, and what was seen of it in the viewer while it was trained."""

    method: str
    folder: Path
    words: tuple[str, ...]
    """What ``ns-train`` was started with, but for the viewer."""
    data: tuple[str, ...]
    """The last words of that command."""
    seen: Look

    @property
    def config(self) -> Path:
        return self.folder / "config.yml"

    @property
    def checkpoint(self) -> Path:
        (path,) = (self.folder / "nerfstudio_models").iterdir()
        return path


def with_the_viewer_open(method: str, capture: Capture, output: Path, words: list[str], data: list[str]) -> Run:
    """Train, look at the viewer in between, and end it by Ctrl-C when the training is complete."""
    seen: list[Look] = []
    update, complete = StoppableTrainer._update_viewer_state, Viewer.training_complete

    def looked_at(trainer: StoppableTrainer, step: int) -> None:
        update(trainer, step)
        if step == LOOKED_AT:
            seen.append(look(trainer.viewer_state, capture.poses[0]))

    def interrupted(viewer: Viewer) -> None:
        complete(viewer)
        viewer.viser_server.stop()
        os.kill(os.getpid(), signal.SIGINT)

    options = ["--vis", "viewer+tensorboard", *VIEWER, "--viewer.max-num-display-images", "3"]
    options += ["--max-num-iterations", str(STEPS[method])]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StoppableTrainer, "_update_viewer_state", looked_at)
        patch.setattr(Viewer, "training_complete", interrupted)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background of a shell it is ignored
        try:
            started(train, *words, *options, *data)
        finally:
            signal.signal(signal.SIGINT, before)
    (folder,) = (output / "room" / method).iterdir()
    return Run(method, folder, tuple(words), tuple(data), *seen)
