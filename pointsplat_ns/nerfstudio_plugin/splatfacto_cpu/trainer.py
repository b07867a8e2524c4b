"""nerfstudio's trainer, for one scene."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.pipelines.base_pipeline import Pipeline, VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torch.cuda.amp.grad_scaler import GradScaler

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.splatfacto import allow_splatfacto_checkpoints
from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanager
from pointsplat_ns.nerfstudio_plugin.optimizers import all_finite
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import LpipsMetric
from pointsplat_ns.nerfstudio_plugin.stopping import STATE, StoppableTrainer
from pointsplat_ns.system.tensors import FLOATS

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import SplatfactoCpuTrainerConfig


MOST_SKIPPED_IN_A_ROW = 10
"""Number of steps in a row that may be skipped because their loss or gradients are not finite, before training stops
and names the photos. One broken photo among sound ones stops nothing."""

_LISTS = ("train_unseen_cameras", "eval_unseen_cameras")
"""Attributes of the datamanager: the frames that are still to come before any is repeated."""


@dataclass
class SplatfactoCpuPipelineConfig(VanillaPipelineConfig):
    """nerfstudio's pipeline, with an evaluation that is always valid JSON"""

    _target: type = field(default_factory=lambda: SplatfactoCpuPipeline)

    def setup(self, **kwargs) -> Any:
        """Build the pipeline, and let torch read nerfstudio's checkpoints, which happens right after this."""
        allow_splatfacto_checkpoints()
        return super().setup(**kwargs)


class SplatfactoCpuPipeline(VanillaPipeline):
    """nerfstudio's pipeline. A metric that cannot be computed is null in its evaluation, never NaN."""

    datamanager: LazyImageDatamanager
    latest_losses: Mapping[str, Tensor] = MappingProxyType({})
    """The parts of the loss of the latest training step."""

    def get_train_loss_dict(self, step: int):
        """As nerfstudio's, and keeps the parts of the loss."""
        outputs, losses, metrics = super().get_train_loss_dict(step)
        self.latest_losses = {name: value.detach() for name, value in losses.items()}
        return outputs, losses, metrics

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Mean metrics over the held-out frames; a DataError if no frame is held out.

        Given a ``step``, by the trainer, whose log takes only finite numbers, other metrics are left out. Without it,
        as in ``ns-eval``, they are None, and ``lpips_note`` says why LPIPS is missing. The standard deviation of a
        single image is None.
        """
        if not self.datamanager.eval_dataset:
            raise DataError(
                f"{self.datamanager.get_datapath()}: no frame is held out, so there is nothing to evaluate on; "
                "expected at least one: change the dataparser's split"
            )
        self.model.lpips = lpips = LpipsMetric()  # a new one, so that its reason is of this evaluation
        metrics = super().get_average_eval_image_metrics(step, output_path, get_std)
        if step is not None:
            return {name: value for name, value in metrics.items() if math.isfinite(value)}
        report: dict[str, Any] = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        if lpips.reason is not None:
            report |= {"lpips": None, "lpips_note": lpips.reason}
        return report


class CheckingOptimizers(Optimizers):
    """nerfstudio's optimisers, which leave out an update that would not be finite. Before each update, ``skips`` is
    called with the groups that have a gradient that is not finite; it returns whether to leave the update out."""

    def __init__(
        self,
        config: dict[str, Any],
        param_groups: dict[str, list[nn.Parameter]],
        skips: Callable[[list[str]], bool],
    ):
        super().__init__(config, param_groups)
        self._skips = skips

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """As nerfstudio's. With a gradient scaler (``--mixed-precision``), the scaler deals with what overflows."""
        if not grad_scaler.is_enabled() and self._skips([name for name in param_groups if not self._finite(name)]):
            self.zero_grad_all()
            return
        super().optimizer_scaler_step_some(grad_scaler, param_groups)

    def _finite(self, name: str) -> bool:
        """Whether all gradients of a group are finite. Its optimiser has its parameters, which densification renews."""
        groups = self.optimizers[name].param_groups
        return all_finite(p.grad for group in groups for p in group["params"] if p.grad is not None)


class SplatfactoCpuTrainer(StoppableTrainer):
    """nerfstudio's trainer, which can be stopped at any time and skips steps that are not finite.

    A step whose loss or gradients are not finite changes neither parameters nor the optimisers' state nor what
    densification gathers. It is counted, and the log names its photo. The learning-rate schedules still advance.
    """

    config: SplatfactoCpuTrainerConfig
    pipeline: SplatfactoCpuPipeline

    def __init__(self, config, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        self.skipped: Counter[str] = Counter()
        """Number of steps that were skipped, by photo."""
        self._skipped_in_a_row = 0

    def train(self) -> None:
        """As nerfstudio's."""
        with tiny_as_zero():
            super().train()

    def setup_optimizers(self) -> CheckingOptimizers:
        """The optimisers."""
        return CheckingOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups(), self._skips)

    def one_step(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """As nerfstudio's, but skips a step whose loss or gradients are not finite. If more than
        :data:`MOST_SKIPPED_IN_A_ROW` have been skipped without one between that was not, a checkpoint is saved, and a
        DataError ends training."""
        loss, losses, metrics = super().one_step(step)
        metrics["skipped_steps"] = self.skipped.total()
        if self._skipped_in_a_row > MOST_SKIPPED_IN_A_ROW:
            self._stop(step)
        return loss, losses, metrics

    def _skips(self, faulty: list[str]) -> bool:
        """Whether to skip the step at hand, given the parameters whose gradient is not finite."""
        losses = self.pipeline.latest_losses
        faults = [f"the {name} is {value.item():g}" for name, value in losses.items() if not value.isfinite()]
        faults = faults or [f"the gradient of the {name} is not finite" for name in faulty]
        if not faults:
            self._skipped_in_a_row = 0
            return False
        photo = self.pipeline.datamanager.latest_photo
        self._skipped_in_a_row += 1
        self.skipped[photo] += 1
        if self.skipped[photo] == 1:
            CONSOLE.log(f"step {self.step} is skipped: {photo}: {'; '.join(faults)} (said once for each photo)")
        self.pipeline.model.forget_step()
        return True

    def _stop(self, step: int) -> None:
        """Save a checkpoint and end training with an error that names the photos."""
        self.save_checkpoint(step)
        photos = ", ".join(f"{name}: {count}" for name, count in self.skipped.most_common(5))
        raise DataError(
            f"training stopped at step {step}: losses or gradients were not finite in the last "
            f"{self._skipped_in_a_row} steps, which were skipped ({photos}); repair these photos or leave them out, or "
            f"lower the learning rates; then go on with --load-dir {self.checkpoint_dir}"
        )

    def state_to_resume(self) -> dict[str, Any]:
        """Random numbers to come, the order of the photos, and what densification has gathered."""
        return training_state(self.pipeline)

    def _load_checkpoint(self) -> None:
        super()._load_checkpoint()
        folder, path = self.config.load_dir, self.config.load_checkpoint
        if folder is not None:
            path = folder / f"step-{self._start_step - 1:09d}.ckpt"
        state = None if path is None else torch.load(path, map_location="cpu", weights_only=True, mmap=True).get(STATE)
        if state is not None:  # those of nerfstudio's own methods have none
            restore_training_state(self.pipeline, state)


def training_state(pipeline: Pipeline) -> dict[str, Any]:
    """Random numbers to come, the order of the frames, and what densification has gathered, as plain values and tensors
    that torch loads with ``weights_only``."""
    manager: Any = pipeline.datamanager
    kind, keys, *rest = np.random.get_state()
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "python": random.getstate(),
        "numpy": [kind, torch.from_numpy(np.asarray(keys, np.int64)), *rest],
        "densification": dict(pipeline.model.strategy_state),
        **{name: list(getattr(manager, name)) for name in _LISTS},
    }
    if hasattr(manager, "random_generator"):  # of the order of the training frames
        state["frames"] = manager.random_generator.getstate()
    return state


def restore_training_state(pipeline: Pipeline, state: Mapping[str, Any]) -> None:
    """Put back what :func:`training_state` gave. Of another number of photos, their order is left alone."""
    manager: Any = pipeline.datamanager
    torch.set_rng_state(state["torch"])
    random.setstate(state["python"])
    kind, keys, *rest = state["numpy"]
    np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))
    model = pipeline.model
    for name, value in state["densification"].items():
        model.strategy_state[name] = value.clone().to(model.device) if isinstance(value, torch.Tensor) else value
    numbers = (len(manager.train_dataset), len(manager.eval_dataset))
    lists = [state[name] for name in _LISTS]
    if all(0 <= index < number for number, indices in zip(numbers, lists, strict=True) for index in indices):
        for name, indices in zip(_LISTS, lists, strict=True):
            setattr(manager, name, list(indices))
        if "frames" in state and hasattr(manager, "random_generator"):
            manager.random_generator.setstate(state["frames"])


@contextmanager
def tiny_as_zero() -> Iterator[None]:
    """Let this thread, and those it starts, take floats below the smallest normal one (1e-38) as 0 while the context is
    open.

    Many processors take ten times as long for such numbers. Adam's averages are full of them where a Gaussian has not
    been seen for 800 steps: they fall by a tenth with each.
    """
    before = takes_tiny_as_zero()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def takes_tiny_as_zero() -> bool:
    """Whether this thread takes floats below the smallest normal one as 0."""
    return not torch.tensor(1e-30, **FLOATS).mul(1e-10).item()
