"""The trainer of one network on many scenes, in one or several processes."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Literal

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.writer import EventName
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from torch.optim.lr_scheduler import LambdaLR

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import labelled
from pointsplat_ns.nerfstudio_plugin.pointsplat.pieces import ScenePiece
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline
from pointsplat_ns.nerfstudio_plugin.pointsplat.progress import (
    CURVES,
    CURVES_PICTURE,
    MOST_ROWS,
    SHEET,
    Progress,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import (
    gains_line,
    mean_gain,
    selection_text,
    split_gains,
    verdict,
)
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainer
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.scene.runs import RUN_FILES
from pointsplat_ns.system import processes
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.system.terminal import say

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import PointSplatTrainerConfig

SECONDS_PER_LINE = 10.0
"""Time after which a line says how far a training is."""

STEPS_TIMED = 5
"""Steps after which the time left is told; the first ones also read, prune and sample."""


def rate_factor_at(
    share: float, schedule: Literal["cosine", "step"], drop_at: float = 0.6
) -> float:
    """Learning rate over its peak, when a share of the training has passed. ``cosine``: from 0
    linearly to 1 at 5 %, then along a cosine to 0.02 at the end. ``step``: 1, and 0.1 from the
    share ``drop_at`` on."""
    if schedule == "step":
        return 1.0 if share < drop_at else 0.1
    warm_up = 0.05
    last = 0.02
    if share < warm_up:
        return share / warm_up
    return cosine_factor(min(1.0, (share - warm_up) / (1 - warm_up)), last)


class PointSplatTrainer(StoppableTrainer):
    """Trains for a number of steps or for a time."""

    config: PointSplatTrainerConfig
    pipeline: PointSplatPipeline
    clock = staticmethod(time.monotonic)
    """Seconds since any moment."""
    stop_training = False  # nerfstudio sets it in train()
    _last_step = sys.maxsize

    def __init__(self, config, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        self._latest = self.clock()
        self.latest_scene = ""
        """Name of the scene of the latest step, also where it was a piece of it."""
        self._step_seconds: deque[float] = deque(maxlen=50)
        self._said_at = 0.0

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """See the base class."""
        super().setup(test_mode)
        self.progress = Progress(self.pipeline)

    def train(self) -> None:
        """See the base class. Before, all scenes are measured."""
        if processes.rank() == 0:
            manager = self.pipeline.datamanager
            length = (
                f"{self.config.max_num_iterations:,} steps"
                if self.config.seconds is None
                else f"{self.config.seconds:g} s"
            )
            watch = f"tensorboard --logdir {self.base_dir}; numbers in {self.base_dir / CURVES}"
            say(
                f"training for {length} on {counted(len(manager.training_names), 'scene')}",
                flush=True,
            )
            say(f"watch it: {watch}", flush=True)
        super().train()

    def train_iteration(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """See the base class. Curves of tensorboard have the names of scenes."""
        first = step == self._start_step and self._asked is None
        if first and self.config.steps_per_eval_image > 0:
            self._measure(step)
        loss, _, metrics = super().train_iteration(step)
        scene = self.pipeline.datamanager.scenes[metrics["scene"]]
        self.latest_scene = scene.of.whole.name if isinstance(scene, ScenePiece) else scene.name
        curves = self.progress.curves
        value = float(loss.detach())
        if math.isfinite(value):
            curves.add_loss(step, self.latest_scene, value)
        if step_check(step, self.config.logging.steps_per_log, run_at_zero=True):
            writer.put_scalar("loss, smoothed/all scenes", curves.loss, step)
            for name, smoothed in curves.losses.items():
                writer.put_scalar(f"loss, smoothed/{name}", smoothed.value, step)
        done = step + 1
        if (
            step_check(done, self.config.steps_per_eval_image)
            and not self._ends_with(step)
            and self.progress.due(self.pipeline.seconds)
        ):
            self._measure(done)
        elif time.monotonic() - self._said_at > SECONDS_PER_LINE:
            self._say(done)
        return loss, {}, {"skipped_steps": metrics["skipped_steps"]}

    def eval_iteration(self, step: int) -> None:
        """Nothing but, if it is asked for, the evaluation on all photos: scenes are measured
        otherwise, also where nothing is logged. What nerfstudio logs of rays is left out."""
        rays = EventName.TRAIN_RAYS_PER_SEC.value
        writer.EVENT_STORAGE[:] = [e for e in writer.EVENT_STORAGE if e["name"] != rays]
        if step_check(step, self.config.steps_per_eval_all_images):
            metrics = self.pipeline.get_average_eval_image_metrics(step=step)
            writer.put_dict("all held-out photos", metrics, step)

    def _ends_with(self, step: int) -> bool:
        """Whether the training ends with a step."""
        return self.stop_training or step + 1 == self._start_step + self.config.max_num_iterations

    def _measure(self, done: int) -> None:
        """Measure all scenes after a number of steps; log, print and save it."""
        measured = self.progress.measure(done)
        if processes.rank() != 0:
            return
        own, others = split_gains(measured.gains)
        for group, scenes in (("trained on", own), ("not trained on", others)):
            for scene in scenes:
                writer.put_scalar(f"gain dB, scenes {group}/{scene.name}", scene.gain, done)
            if (mean := mean_gain(scenes)) is not None:
                writer.put_scalar(f"gain dB, mean/scenes {group}", mean, done)
        start = time.monotonic()
        for index in self._shown():
            pictures = self.progress.pictures(index)
            name = self.pipeline.datamanager.scenes[index].name
            sheet = labelled([p for p, _ in pictures.values()], list(pictures))
            writer.put_image(f"{' | '.join(pictures)}/{name}", sheet, done)
        if len(self.progress.curves.measurements) > 1:
            self.progress.spent += time.monotonic() - start
        self.progress.curves.write(self.base_dir / CURVES)
        self._say(done, gains_line(measured.gains))

    def _shown(self) -> list[int]:
        """Indices of the scenes of which there are pictures: the first ones of both kinds."""
        own, others = self.progress.own, self.progress.others
        first = own[: MOST_ROWS - min(len(others), MOST_ROWS // 2)]
        return [*first, *others[: MOST_ROWS - len(first)]]

    def _say(self, done: int, gains: str = "") -> None:
        """Print the steps done, the loss, the gains and the time left."""
        self._said_at = time.monotonic()
        if processes.rank() != 0:
            return
        curves = self.progress.curves
        words = [f"step {done:,}" + self._of_all()]
        words += [f"loss {curves.loss:.4f}"] * bool(curves.losses) + [gains] * bool(gains)
        left = self.seconds_left(done)
        words += [] if left is None else [f"{duration(left)} left"]
        say("; ".join(words), flush=True)

    def _of_all(self) -> str:
        if self.config.seconds is not None:
            return ""
        return f" of {self._start_step + self.config.max_num_iterations:,}"

    def seconds_left(self, done: int) -> float | None:
        """Time until the training ends, seconds; None before it is known."""
        if self.config.seconds is not None:
            return max(0.0, self.config.seconds - self.pipeline.seconds)
        if len(self._step_seconds) < STEPS_TIMED:
            return None
        left = self._start_step + self.config.max_num_iterations - done
        return left * median(self._step_seconds)

    def report(self) -> None:
        """Measure all scenes at the end, and print and draw what the training gained. Raises
        KeyboardInterrupt if the training was asked to stop while its results were written."""
        self.results_written()
        done = self.step + 1
        measured = self.progress.measure(done)
        if processes.rank() != 0:
            return
        for scene in sorted(measured.gains, key=lambda scene: not scene.trained_on):
            kind = "trained on" if scene.trained_on else "not trained on"
            change = f"pruned {scene.pruned:.1f} -> refined {scene.refined:.1f} dB"
            views = counted(scene.views, "view")
            say(f"{scene.name} ({kind}): {change} ({scene.gain:+.1f}) in {views}", flush=True)
        say(verdict(measured.gains), flush=True)
        say(f"see {', '.join(map(str, self.draw()))}", flush=True)
        say(
            f"all held-out photos: ns-eval --load-config {self.base_dir / RUN_FILES.config}",
            flush=True,
        )

    def show_progress(self) -> None:
        """See the base class: what :meth:`draw` writes."""
        if self.progress.curves.measurements and processes.rank() == 0:
            say(f"see {', '.join(map(str, self.draw()))}", flush=True)

    def draw(self) -> list[Path]:
        """Write the table, the curves and the sheet of views; their paths."""
        from pointsplat_ns.nerfstudio_plugin.pointsplat import training_pictures

        paths = [self.base_dir / name for name in (CURVES, CURVES_PICTURE, SHEET)]
        self.progress.curves.write(paths[0])
        title = selection_text(self.config.model_config.prune_settings())
        training_pictures.plot_curves(self.progress.curves, paths[1], title)
        latest = {scene.name: scene for scene in self.progress.curves.measurements[-1].gains}
        rows = []
        for index in self._shown():
            name = self.pipeline.datamanager.scenes[index].name
            kind = "trained on" if latest[name].trained_on else "not trained on"
            rows.append((f"{name}\n{kind}", self.progress.pictures(index)))
        training_pictures.plot_sheet(rows, paths[2])
        return paths

    def setup_optimizers(self) -> Optimizers:
        """The optimisers, and the schedules of those that have none of their own."""
        optimizers = super().setup_optimizers()
        for name, optimizer in optimizers.optimizers.items():
            if name not in optimizers.schedulers:
                optimizers.schedulers[name] = LambdaLR(
                    optimizer,
                    lambda steps: rate_factor_at(
                        self.share(steps), self.config.schedule, self.config.drop_at
                    ),
                )
        return optimizers

    def share(self, steps: int) -> float:
        """Share of the training that has passed after a number of steps; with ``seconds``, of the
        time."""
        if self.config.seconds is not None:
            return self.pipeline.seconds / self.config.seconds
        return steps / max(1, self._start_step + self.config.max_num_iterations)

    def _load_checkpoint(self) -> None:
        """As nerfstudio's. Raises PointSplatError if the training has taken all of ``seconds``
        before."""
        super()._load_checkpoint()
        spent = self.pipeline.seconds
        seconds = self.config.seconds
        if seconds is not None and spent >= seconds:
            raise PointSplatError(
                f"--seconds {seconds:g}: the training has taken {spent:.0f} s up to its "
                "checkpoint; expected more, as it is the total"
            )

    def update(self, step: int, skipped: bool) -> None:
        """As the base class. Before, count the time since the step before, and end the training
        after this one if the time is over. The first process's clock counts in all."""
        pipeline = self.pipeline
        now = self.clock()
        if step > self._start_step:  # the first one also reads and prunes scenes
            self._step_seconds.append(now - self._latest)
        (pipeline.seconds, *_), self._latest = (
            processes.gathered([pipeline.seconds + now - self._latest]),
            now,
        )
        if self.config.seconds is not None:
            share = self.share(step)
            if share >= 1:
                self.stop_training = True
                self._last_step = step
                log(f"the time is over: {step + 1} steps in {pipeline.seconds:.0f} s")
        super().update(step, skipped)

    def clip(self) -> None:
        """Scale all gradients down to the norm ``global_norm`` of the config, if it is set and they
        exceed it."""
        if self.config.global_norm is not None:
            groups = [self._trained(name) for name in self.optimizers.optimizers]
            clip_grad_norm_([p for group in groups for p in group], self.config.global_norm)

    def _after_train(self) -> None:
        """As nerfstudio's, which counts the step before which it stops as done."""
        self.step = min(self.step, self._last_step)
        super()._after_train()

    def source_of(self, metrics: dict[str, Any]) -> str:
        """Name of the scene of the latest step."""
        return self.pipeline.datamanager.scenes[metrics["scene"]].name


def duration(seconds: float) -> str:
    """A time in words of the right size."""
    minutes = seconds / 60
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
