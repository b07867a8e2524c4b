"""The trainer of both methods: nerfstudio's, which can be stopped at any time and skips steps that
are not finite."""

from __future__ import annotations

import functools
import shutil
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NoReturn

import torch
import yaml
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread
from torch import Tensor, nn
from tyro.conf import Fixed, Suppress

from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.nerfstudio_plugin.cameras import RasterizerOptions
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.frames import tensor_bytes
from pointsplat_ns.nerfstudio_plugin.option_checks import check_options
from pointsplat_ns.scene.checkpoints import read_training_state
from pointsplat_ns.scene.runs import RUN_FILES, step_of
from pointsplat_ns.system import processes
from pointsplat_ns.system.files import one_line, replacing
from pointsplat_ns.system.memory import keep_freed_memory
from pointsplat_ns.system.terminal import say
from pointsplat_ns.system.threads import fixed_threads, one_thread_each

STATE = "pointsplat"
"""Key in checkpoints of what a trainer needs to go on as if it had not been stopped; nerfstudio
ignores it."""

MOST_SKIPPED_IN_A_ROW = 10
"""Number of steps in a row that may be skipped, before training stops and names their photos or
scenes."""


@dataclass
class StoppableTrainerConfig(TrainerConfig):
    """nerfstudio's trainer config, with the number of threads"""

    threads: int | None = None
    """Number of threads of a training on a CPU. By default as many as other programs leave cores;
    the environment variable OMP_NUM_THREADS has the same effect as this. Another number may change
    results by rounding."""

    # Settings of nerfstudio's that have no effect here: hidden on the command line.
    mixed_precision: Suppress[Fixed[bool]] = False
    use_grad_scaler: Suppress[Fixed[bool]] = False
    gradient_accumulation_steps: Suppress[Fixed[dict[str, int]]] = field(default_factory=dict)
    log_gradients: Suppress[Fixed[bool]] = False

    def set_timestamp(self) -> None:
        """As nerfstudio's. It is the first that ``ns-train`` calls, so all options are checked
        here, before anything is written."""
        self.check()
        super().set_timestamp()

    def check(self) -> None:
        """Raise PointSplatError for options that no training can have."""
        if self.max_num_iterations < 1:
            raise PointSplatError(
                f"--max-num-iterations {self.max_num_iterations}: expected at least 1; a run is "
                "shown and measured without a training by ns-viewer, ns-render and ns-eval"
            )
        check_options(self)

    def save_config(self) -> None:
        """Write nothing yet: the trainer does, once scenes and checkpoints are loaded, so that a
        command that fails leaves no folder of a run (:meth:`write_config`)."""

    def write_config(self) -> None:
        """Write ``config.yml``, whole or not at all, by the first process. Raises PointSplatError
        if it cannot be written."""
        path = self.get_base_dir() / RUN_FILES.config

        def write() -> None:
            log(f"Saving config to: {path}")
            with replacing(path, named=False) as part:
                part.write_text(yaml.dump(self), "utf-8")

        processes.by_first(write)

    def trainer(self, fitted: Any, **kwargs: Any) -> Trainer:
        """The trainer of a copy of this config, which is checked, fitted to the training; what it
        saves as ``config.yml`` is this one."""
        trainer = self._target(fitted, **kwargs)
        trainer.given_config = self
        return trainer

    def first_step(self) -> int:
        """The step that a training begins with: 0, or the step in the name of the checkpoint that
        it resumes from."""
        path = self.checkpoint_to_load()
        step = None if path is None else step_of(path)
        return 0 if step is None else step + 1

    def checkpoint_to_load(self) -> Path | None:
        """The checkpoint that a training goes on from; None if it begins anew. Raises SceneError if
        there is no such file."""
        folder = self.load_dir
        if folder is None:
            path = self.load_checkpoint
            if path is not None and not path.is_file():
                raise SceneError(f"--load-checkpoint {path}: no such file; expected step-N.ckpt")
            return path
        steps = {
            step: path for path in folder.glob("step-*.ckpt") if (step := step_of(path)) is not None
        }
        wanted = max(steps, default=None) if self.load_step is None else self.load_step
        if wanted not in steps:
            found = ", ".join(map(str, sorted(steps))) or "none"
            what = "a run's nerfstudio_models" if wanted is None else f"step {wanted}"
            raise SceneError(f"--load-dir {folder}: expected checkpoints of {what}; found {found}")
        return steps[wanted]


class StoppableTrainer(Trainer):
    """nerfstudio's trainer. On a CPU it reuses freed memory, and takes as many threads as other
    programs leave cores.

    Checkpoints and the config are written beside and renamed, so that one that is there is whole.
    Ctrl-C and SIGTERM end it after the step at hand, with a checkpoint of that step, and with the
    status of an interrupted program: in the middle of densification, parameters are of different
    numbers. Before the first step they end it at once, and after the last step once its results are
    written. A second one ends it at once.

    A step whose loss or gradients are not finite, in any process, changes neither parameters nor
    the optimisers' state nor buffers. It is counted, and the log names its photo or scene. The
    learning-rate schedules still advance.
    """

    config: StoppableTrainerConfig
    given_config: StoppableTrainerConfig | None = None
    """The config that is saved: as given, before it was fitted to the training."""
    _own_folder = False
    """Whether the run's folder was not there before."""
    _asked: int | None = None
    """Number of the signal that asked it to stop."""
    _between_steps = False
    """Whether it was stopped where a checkpoint can be saved."""
    _begun = False
    """Whether the first step of this call has begun."""
    _finishing = False
    """Whether the results of all steps are being written."""

    def __init__(self, config: Any, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        self.skipped: Counter[str] = Counter()
        """Number of steps that were skipped, by photo or scene, over all processes."""
        self._skipped_in_a_row = 0
        self._own_folder = not self.base_dir.exists()

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio's; a line of the log names the rasterizer."""
        if torch.device(self.device).type == "cpu":
            keep_freed_memory()
        try:
            with self._signals_heeded(self._end), self._no_folder_of_nothing():
                if self.config.is_viewer_enabled() or self.config.is_viewer_legacy_enabled():
                    self.base_dir.mkdir(parents=True, exist_ok=True)  # for the viewer's log
                super().setup(test_mode)
                if self.given_config is not None:
                    self.given_config.write_config()
            model = self.config.pipeline.model
            if self.local_rank == 0 and isinstance(model, RasterizerOptions):
                log(model.engine(torch.device(self.device)))
        except KeyboardInterrupt:
            _interrupted(self._asked or signal.SIGINT)
        if self.local_rank == 0:
            # nerfstudio takes the steps of this call for the last step, also where a training
            # resumes from a later one.
            writer.GLOBAL_BUFFER["max_iter"] = self._start_step + self.config.max_num_iterations

    def train(self) -> None:
        """As nerfstudio's, but Ctrl-C saves a checkpoint and ends ``ns-train`` with status 130.
        nerfstudio saves none and ends with 0, as if it had finished."""
        with fixed_threads(self.config.threads), self._signals_heeded(self._note):
            try:
                with self._no_folder_of_nothing():
                    super().train()
            except KeyboardInterrupt:
                with suppress(KeyboardInterrupt):  # a second one
                    self._save_interrupted()
                _interrupted(self._asked or signal.SIGINT)

    def _save_interrupted(self) -> None:
        """Save a checkpoint of the steps that an interrupted training has done, if they can be
        saved and are not yet, and say so."""
        if self.training_state == "completed":
            log(f"All steps are done and saved: {self.checkpoint_dir}")
        elif self._between_steps and self.step > self._start_step:
            self.save_checkpoint(self.step - 1)
            log(
                f"Saved after step {self.step - 1}. The run is usable as it is; to go on: "
                f"--load-dir {self.checkpoint_dir}"
            )
            self.show_progress()

    @contextmanager
    def _no_folder_of_nothing(self) -> Iterator[None]:
        """If an error ends this before a step is done, remove the run's folder, unless it was there
        before."""
        try:
            yield
        except BaseException:
            if self._own_folder and self.local_rank == 0 and self.step <= self._start_step:
                for kind in [kind for kind in writer.EVENT_WRITERS if hasattr(kind, "tb_writer")]:
                    kind.tb_writer.close()
                    writer.EVENT_WRITERS.remove(kind)
                shutil.rmtree(self.base_dir, ignore_errors=True)
                for above in self.base_dir.parents[:3]:  # METHOD, EXPERIMENT, the output folder
                    with suppress(OSError):  # not empty
                        above.rmdir()
            raise

    def _load_checkpoint(self) -> None:
        """As nerfstudio's. Raises SceneError if the checkpoint is missing, truncated, or of another
        method or other settings."""
        path = self.config.checkpoint_to_load()
        if path is None:
            return
        content = read_training_state(path)
        try:
            self.pipeline.load_pipeline(content["pipeline"], content["step"])
            self.optimizers.load_optimizers(content["optimizers"])
            if "schedulers" in content and self.config.load_scheduler:
                self.optimizers.load_schedulers(content["schedulers"])
            self.grad_scaler.load_state_dict(content["scalers"])
            self._start_step = content["step"] + 1
            self.put_back(content.get(STATE))
        except PointSplatError:
            raise
        except Exception as error:  # the file's content can be anything
            raise SceneError(
                f"{path}: no training of {self.config.method_name} can go on from it "
                f"({type(error).__name__}: {one_line(error, 160)}); expected a checkpoint of the "
                "same method and settings"
            ) from error
        self.step = self._start_step
        log(f"going on after step {content['step']} of {path}")

    def show_progress(self) -> None:
        """Write what tells how far an interrupted training came; nothing by default."""

    def put_back(self, state: Any) -> None:
        """Put back :meth:`state_to_resume`; None if the checkpoint has none."""

    def _after_train(self) -> None:
        """As nerfstudio's. A signal waits until the results are written."""
        self._finishing = True
        super()._after_train()

    def results_written(self) -> None:
        """From now on, a signal ends the program at once. Raises KeyboardInterrupt if one has
        come."""
        self._finishing = False
        if self._asked is not None:
            raise KeyboardInterrupt

    def _train_complete_viewer(self) -> None:
        """Keep the viewer open after the last step until Ctrl-C or SIGTERM, once: the training is
        complete."""
        self._finishing = False
        with suppress(KeyboardInterrupt):
            if self._asked is None:
                super()._train_complete_viewer()

    def train_iteration(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """The loss, its parts, and numbers for the log, as nerfstudio's, which cannot skip a step.
        Raises DataError after more than :data:`MOST_SKIPPED_IN_A_ROW` skipped steps, and
        KeyboardInterrupt if the training was asked to stop."""
        if self._asked is not None:
            self._between_steps = True
            raise KeyboardInterrupt
        self._begun = True
        with one_thread_each():
            buffers = [(buffer, buffer.clone()) for buffer in self.pipeline.model.buffers()]
            self.optimizers.zero_grad_all()
            _, losses, metrics = self.pipeline.get_train_loss_dict(step=step)
            loss = functools.reduce(torch.add, losses.values())
            faults = [
                f"the loss {name} is {value.item():g}"
                for name, value in losses.items()
                if not value.isfinite()
            ]
            skip = processes.any_rank(bool(faults), self.device)
            if not skip:
                loss.backward()
                bad = [
                    name
                    for name in self.optimizers.optimizers
                    if not all_finite(self._trained(name))
                ]
                faults = [f"the gradient of the {name} is not finite" for name in bad]
                skip = processes.any_rank(bool(faults), self.device)
            if skip:
                self.optimizers.zero_grad_all()
                with torch.no_grad():
                    for buffer, before in buffers:
                        buffer.copy_(before)
                self._count(step, self.source_of(metrics), faults)
            self.update(step, skip)
            self._skipped_in_a_row = self._skipped_in_a_row + 1 if skip else 0
            if self._skipped_in_a_row > MOST_SKIPPED_IN_A_ROW:
                self.save_checkpoint(step)
                sources = ", ".join(
                    f"{name}: {count}" for name, count in self.skipped.most_common(5)
                )
                raise DataError(
                    f"training stopped at step {step}: losses or gradients were not finite in the "
                    f"last {self._skipped_in_a_row} steps, which were skipped ({sources}); mend or "
                    "leave out what is named, or lower the learning rates; then go on with "
                    f"--load-dir {self.checkpoint_dir}"
                )
            return loss, losses, {**metrics, "skipped_steps": self.skipped.total()}

    def update(self, step: int, skipped: bool) -> None:
        """Step the optimisers, by gradients averaged over processes, unless the step is skipped;
        and all schedules."""
        if not skipped:
            for name in self.optimizers.optimizers:
                processes.average_gradients(self._trained(name))
            self.clip()
            self.optimizers.optimizer_step_all()
        self.optimizers.scheduler_step_all(step)

    def clip(self) -> None:
        """Limit all gradients together, before each optimiser limits its own; by default they are
        left alone."""

    def _trained(self, group: str) -> list[nn.Parameter]:
        """Parameters of a group: its optimiser has them, also where densification renews them."""
        return [
            p for part in self.optimizers.optimizers[group].param_groups for p in part["params"]
        ]

    def source_of(self, metrics: dict[str, Any]) -> str:
        """Name of the photo or scene of the latest step."""
        raise NotImplementedError

    def _count(self, step: int, source: str, faults: list[str]) -> None:
        """Count and log the sources, of all processes, that made a step be skipped."""
        for name, text in processes.gathered([(source, "; ".join(faults))] if faults else []):
            self.skipped[name] += 1
            if self.skipped[name] == 1 and processes.rank() == 0:
                log(f"step {step} is skipped: {name}: {text} (said once for each)")

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """As nerfstudio's, but a checkpoint is whole before it is there, and holds
        :meth:`state_to_resume`. If it cannot be written, as on a full disk, older ones are left
        alone, and a SceneError says so."""
        pipeline = getattr(self.pipeline, "module", self.pipeline)
        content: dict[str, Any] = {
            "step": step,
            "pipeline": pipeline.state_dict(),
            "optimizers": {
                name: optimizer.state_dict()
                for name, optimizer in self.optimizers.optimizers.items()
            },
            "schedulers": {
                name: scheduler.state_dict()
                for name, scheduler in self.optimizers.schedulers.items()
            },
            "scalers": self.grad_scaler.state_dict(),
        }
        if state := self.state_to_resume():
            content[STATE] = state
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        # Unfinished in the run's folder: nerfstudio takes every file beside checkpoints for one.
        with replacing(path, tensor_bytes(content), self.base_dir, named=False) as part:
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
    def _signals_heeded(self, heed: Callable[[int, FrameType | None], None]) -> Iterator[None]:
        """While this is open, ``heed`` handles signals that would end the program. Not where
        several processes train together: they save together, and one of them cannot stop alone."""
        before = {}
        if threading.current_thread() is threading.main_thread() and self.world_size == 1:
            for number, usual in (
                (signal.SIGINT, signal.default_int_handler),
                (signal.SIGTERM, signal.SIG_DFL),
            ):
                if signal.getsignal(number) is usual:
                    before[number] = signal.signal(number, heed)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _end(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal before the first step."""
        self._asked = number
        raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        first = self._asked is None
        self._asked = self._asked or number
        self._between_steps = self.training_state == "paused"
        waits = self._finishing or (self._begun and self.training_state == "training")
        if not (first and waits):
            raise KeyboardInterrupt
        when = "once the results are written" if self._finishing else "after this step"
        say(f"stopping {when}; once more to stop at once, without saving", error=True)


def all_finite(parameters: list[nn.Parameter]) -> bool:
    """Whether all gradients are finite. A sum is not if a number is not, and is a fifth of the
    work; where it overflows, each number is checked."""
    gradients = (p.grad for p in parameters if p.grad is not None)
    return all(
        bool(gradient.sum().isfinite()) or bool(gradient.isfinite().all()) for gradient in gradients
    )


def _interrupted(number: int) -> NoReturn:
    """End the program as a signal does, past nerfstudio, which catches KeyboardInterrupt alone."""
    say("interrupted", error=True)
    sys.exit(128 + number)
