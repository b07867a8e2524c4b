"""nerfstudio's trainer, for one scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torch.cuda.amp.grad_scaler import GradScaler

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.optimizers import all_finite
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.early_look import EarlyLook
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuPipeline
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.resuming import restore_training_state, training_state
from pointsplat_ns.nerfstudio_plugin.stopping import STATE, StoppableTrainer
from pointsplat_ns.system.small_numbers import tiny_as_zero

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import SplatfactoCpuTrainerConfig


class CheckingOptimizers(Optimizers):
    """nerfstudio's optimisers, which leave out an update that would not be finite. Before each update, ``skips`` is
    told of the groups with a gradient that is not finite, and says whether to leave it out."""

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
    """nerfstudio's trainer, which can be stopped at any time and tells early how long it takes and what comes of it.

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

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio's. Raises PointSplatError if the data cannot be used, or ``max_skipped_in_a_row`` is
        negative."""
        if self.config.max_skipped_in_a_row < 0:
            raise PointSplatError(f"--max-skipped-in-a-row {self.config.max_skipped_in_a_row}: expected at least 0")
        super().setup(test_mode)
        if self.config.early_look and test_mode == "val":
            pictures = self.base_dir / "pictures"
            look = EarlyLook(self.pipeline, pictures, self._start_step, self.config.max_num_iterations)

            def after_training(step: int) -> None:
                with self.train_lock:  # as nerfstudio holds it in a step: the viewer's threads draw with the same model
                    look.after_training(step)

            before, after = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN
            self.callbacks.append(TrainingCallback([before], look.before_step, update_every_num_iters=1))
            self.callbacks.append(TrainingCallback([after], after_training, update_every_num_iters=1))

    def train(self) -> None:
        """As nerfstudio's."""
        with tiny_as_zero():
            super().train()

    def setup_optimizers(self) -> CheckingOptimizers:
        """The optimisers."""
        return CheckingOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups(), self._skips)

    def one_step(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """As nerfstudio's, but skips a step whose loss or gradients are not finite. If more than
        ``max_skipped_in_a_row`` have been skipped without one between that was not, a checkpoint is saved, and a
        DataError ends training."""
        loss, losses, metrics = super().one_step(step)
        metrics["skipped_steps"] = self.skipped.total()
        if self._skipped_in_a_row > self.config.max_skipped_in_a_row:
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
