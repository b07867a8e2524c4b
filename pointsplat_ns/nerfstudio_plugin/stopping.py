"""nerfstudio's trainer, which can be stopped at any time."""

from __future__ import annotations

import functools
import itertools
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NoReturn

import torch
import yaml
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.io.files import one_line, replacing
from pointsplat_ns.io.runs import step_of
from pointsplat_ns.nerfstudio_plugin.rasterizer_options import RasterizerOptions
from pointsplat_ns.system.memory import keep_freed_memory
from pointsplat_ns.system.threads import fixed_threads, suitable_threads

STATE = "pointsplat"
"""Key in checkpoints of what a trainer needs to go on as if it had not been stopped; nerfstudio ignores it."""


@dataclass
class StoppableTrainerConfig(TrainerConfig):
    """nerfstudio's trainer config, with the number of threads"""

    threads: int | None = None
    """Number of threads of a training on a CPU. By default as many as other programs leave cores; the environment
    variable OMP_NUM_THREADS has the same effect as this. Another number may change results by rounding."""

    def save_config(self) -> None:
        """As nerfstudio's, but whole or not at all, and in a folder of its own (:meth:`take_folder`)."""
        self.take_folder()
        path = self.get_base_dir() / "config.yml"
        CONSOLE.log(f"Saving config to: {path}")
        with replacing(path) as part:
            part.write_text(yaml.dump(self), "utf-8")

    def take_folder(self) -> None:
        """Make the folder of the run. If there is one of that name, as of a training that was started in the same
        second, change the timestamp: two trainings in one folder would replace each other's files. A training that
        resumes from a checkpoint in its own folder stays there. Raises PointSplatError if no folder can be made."""
        given = self.get_base_dir()
        resumed = self.load_dir or (self.load_checkpoint and self.load_checkpoint.parent)
        if resumed is not None and resumed.resolve() == self.get_checkpoint_dir().resolve():
            return
        timestamp = self.timestamp
        try:
            given.parent.mkdir(parents=True, exist_ok=True)
            for number in itertools.count(2):
                try:
                    self.get_base_dir().mkdir()
                    break
                except FileExistsError:
                    self.timestamp = f"{timestamp}_{number}"
        except OSError as error:
            raise PointSplatError(
                f"{given}: cannot be made as the folder of this training ({error.strerror}); name another --output-dir"
            ) from error
        if self.timestamp != timestamp:
            CONSOLE.log(f"{given} is the folder of another training; this one gets {self.get_base_dir()}")

    def first_step(self) -> int:
        """The step that a training begins with: 0, or the step in the name of the checkpoint that it resumes from."""
        if self.load_dir is None:
            return 0 if self.load_checkpoint is None else _step_after(self.load_checkpoint)
        if self.load_step is not None:
            return self.load_step + 1
        return max((_step_after(path) for path in self.load_dir.glob("step-*.ckpt")), default=0)


class StoppableTrainer(Trainer):
    """nerfstudio's trainer. It removes the run folder if the input cannot be used, and reuses freed memory on a CPU.

    Steps on a CPU use as many threads as other programs leave cores
    (:func:`~pointsplat_ns.system.threads.suitable_threads`).

    Checkpoints and the other files of a run are written beside and renamed, so that one that is there is whole,
    however the training ended.

    Ctrl-C and SIGTERM end it after the step at hand, with a checkpoint of that step, and with the status of an
    interrupted program: in the middle of densification, parameters are of different numbers. A second one ends it at
    once.
    """

    config: StoppableTrainerConfig
    _asked: int | None = None
    """Number of the signal that asked it to stop."""
    _between_steps = False
    """Whether it was stopped where a checkpoint can be saved."""

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio's. If the data or a number of steps cannot be used, the run folder, which then holds only the
        config, is removed before the PointSplatError."""
        if torch.device(self.device).type == "cpu":
            keep_freed_memory()
        try:
            self._need_steps()
            super().setup(test_mode)
            model = self.config.pipeline.model
            if self.local_rank == 0 and isinstance(model, RasterizerOptions):
                CONSOLE.log(model.engine(torch.device(self.device)))
        except PointSplatError:
            self._withdraw()
            raise
        except KeyboardInterrupt:
            _interrupted(signal.SIGINT)
        if self.local_rank == 0:
            # nerfstudio takes the steps of this call for the last step, also where a training resumes from a later one.
            writer.GLOBAL_BUFFER["max_iter"] = self._start_step + self.config.max_num_iterations
        outputs = getattr(self.pipeline.datamanager, "train_dataparser_outputs", None)
        if outputs is not None:
            outputs.save_dataparser_transform = functools.partial(_save_whole, outputs.save_dataparser_transform)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        self.callbacks.append(TrainingCallback(before, self._stop_if_asked, update_every_num_iters=1))

    def train(self) -> None:
        """As nerfstudio's, but Ctrl-C saves a checkpoint and ends ``ns-train`` with status 130. nerfstudio saves none
        and ends with 0, as if it had finished. Raises PointSplatError if the number of threads is below 1."""
        with fixed_threads(self.config.threads), self._signals_noted():
            try:
                try:
                    super().train()
                finally:
                    self.end_background()
            except KeyboardInterrupt:
                if self._between_steps and self.step > self._start_step:
                    self.save_checkpoint(self.step - 1)
                    CONSOLE.log(
                        f"Saved after step {self.step - 1}. The run is usable as it is; to go on: --load-dir "
                        f"{self.checkpoint_dir}"
                    )
                _interrupted(self._asked or signal.SIGINT)

    def end_background(self) -> None:
        """End what a training does beside its steps; by default there is nothing."""

    def _train_complete_viewer(self) -> None:
        """Keep the viewer open after the last step until Ctrl-C or SIGTERM. The training is complete: they end it as
        such, and need not come twice."""
        with suppress(KeyboardInterrupt):
            if self._asked is None:
                super()._train_complete_viewer()

    def train_iteration(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """One step, with the number of threads that suits it."""
        with suitable_threads(torch.device(self.device)):
            return self.one_step(step)

    def one_step(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """One step: the loss, its parts, and other numbers. As nerfstudio's."""
        return super().train_iteration(step)

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """As nerfstudio's, but a checkpoint is whole before it is there, and holds :meth:`state_to_resume`. If it
        cannot be written, as on a full disk, older ones are left alone, and a SceneError says so."""
        pipeline = getattr(self.pipeline, "module", self.pipeline)
        content: dict[str, Any] = {
            "step": step,
            "pipeline": pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {name: scheduler.state_dict() for name, scheduler in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }
        if state := self.state_to_resume():
            content[STATE] = state
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        # Unfinished in the run's folder: nerfstudio takes every file beside checkpoints for one.
        with replacing(path, _tensor_bytes(content), self.base_dir) as part:
            try:
                torch.save(content, part)
            except RuntimeError as error:  # what torch makes of a disk that is full after all
                raise OSError(one_line(error)) from error
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != path:
                    other.unlink()

    def state_to_resume(self) -> dict[str, Any]:
        """State of the training beside weights, optimisers and schedules; empty by default."""
        return {}

    @contextmanager
    def _signals_noted(self) -> Iterator[None]:
        """While this is open, signals that would end the program end the training after its step.

        Not where several processes train together: they save together, and one of them cannot stop alone.
        """
        numbers = []
        if threading.current_thread() is threading.main_thread() and self.world_size == 1:
            numbers += [signal.SIGINT] if signal.getsignal(signal.SIGINT) is signal.default_int_handler else []
            numbers += [signal.SIGTERM] if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL else []
        before = {number: signal.signal(number, self._note) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        first, self._asked = self._asked is None, self._asked or number
        self._between_steps = self.training_state == "paused"
        if not first or self.training_state != "training":
            raise KeyboardInterrupt
        print("stopping after this step; once more to stop at once, without saving it", file=sys.stderr)

    def _stop_if_asked(self, step: int) -> None:
        """Called before each step."""
        if self._asked is not None:
            self._between_steps = True
            raise KeyboardInterrupt

    def _need_steps(self) -> None:
        if self.config.max_num_iterations < 1:
            raise PointSplatError(
                f"--max-num-iterations {self.config.max_num_iterations}: expected at least 1; a run is shown and "
                "measured without a training by ns-viewer, ns-render and ns-eval"
            )

    def _withdraw(self) -> None:
        config = self.base_dir / "config.yml"
        if not config.is_file() or list(self.base_dir.iterdir()) != [config]:
            return
        config.unlink()
        output_dir = Path(self.config.output_dir)
        for folder in (self.base_dir, *self.base_dir.parents):
            if folder == output_dir.parent or any(folder.iterdir()):
                break
            folder.rmdir()


def _step_after(checkpoint: Path) -> int:
    """The step that follows a checkpoint's; 0 if its name does not say which that is."""
    step = step_of(checkpoint)
    return 0 if step is None else step + 1


def _save_whole(save: Callable[[Path], None], path: Path) -> None:
    """Save a file by a function that writes it in place."""
    with replacing(path) as part:
        save(part)


def _tensor_bytes(value: Any) -> int:
    """Bytes of all tensors in nested dictionaries and lists."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
    return sum(map(_tensor_bytes, parts))


def _interrupted(number: int) -> NoReturn:
    """End the program as a signal does, past nerfstudio, which catches KeyboardInterrupt alone."""
    print("interrupted", file=sys.stderr)
    sys.exit(128 + number)
