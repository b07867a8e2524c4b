"""Checks the options of a training that nerfstudio does not check: those that end it in a
traceback, or in a scene of NaN.

Rules go by the names of fields, wherever in the configuration they are. Every number must be
finite.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE
from pointsplat_ns.system.threads import MOST_THREADS


@dataclass(frozen=True)
class Bounds:
    """The numbers that an option may have."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """Whether ``low``, 0, is itself excluded."""

    def hold(self, value: float) -> bool:
        """Whether a number is finite and within."""
        enough = value > self.low if self.above else value >= self.low
        return math.isfinite(value) and enough and value <= self.high

    def text(self, value: float) -> str:
        """What is expected in place of a number."""
        whole = "a whole number" if isinstance(value, int) else "a finite number"
        if self.high < math.inf:
            return f"{whole} from {self.low:g} to {self.high:.10g}" + ", not 0" * self.above
        if self.low > -math.inf:
            return f"{whole} above 0" if self.above else f"{whole}, {self.low:g} or more"
        return whole


FINITE = Bounds()
NOT_NEGATIVE = Bounds(0)
POSITIVE = Bounds(0, above=True)
AT_LEAST_ONE = Bounds(1)
SHARE = Bounds(0, 1)

RULES: Mapping[str, Bounds] = {
    # the model
    "sh_degree": Bounds(0, MAX_SH_DEGREE),
    "num_downscales": NOT_NEGATIVE,
    "num_random": AT_LEAST_ONE,
    "random_scale": POSITIVE,
    "refine_every": AT_LEAST_ONE,
    "reset_alpha_every": AT_LEAST_ONE,
    "resolution_schedule": AT_LEAST_ONE,
    "sh_degree_interval": AT_LEAST_ONE,
    "n_split_samples": AT_LEAST_ONE,
    "warmup_length": NOT_NEGATIVE,
    "stop_split_at": NOT_NEGATIVE,
    "stop_screen_size_at": NOT_NEGATIVE,
    "cull_alpha_thresh": SHARE,
    "ssim_lambda": SHARE,
    "cull_scale_thresh": NOT_NEGATIVE,
    "densify_grad_thresh": NOT_NEGATIVE,
    "densify_size_thresh": NOT_NEGATIVE,
    "cull_screen_size": NOT_NEGATIVE,
    "split_screen_size": NOT_NEGATIVE,
    "max_gauss_ratio": POSITIVE,
    "grid_shape": AT_LEAST_ONE,
    "rot_l2_penalty": NOT_NEGATIVE,
    "trans_l2_penalty": NOT_NEGATIVE,
    # photos and poses
    "camera_res_scale_factor": POSITIVE,
    "cache_gigabytes": NOT_NEGATIVE,
    "fps_reset_every": AT_LEAST_ONE,
    "scale_factor": POSITIVE,
    "scene_scale": POSITIVE,
    "downscale_factor": AT_LEAST_ONE,
    "depth_unit_scale_factor": POSITIVE,
    "train_split_fraction": Bounds(0, 1, above=True),
    "eval_interval": Bounds(2),
    # optimisers and schedules
    "lr": NOT_NEGATIVE,
    "eps": NOT_NEGATIVE,
    "weight_decay": NOT_NEGATIVE,
    "max_norm": POSITIVE,
    "lr_final": POSITIVE,
    "lr_pre_warmup": NOT_NEGATIVE,
    "warmup_steps": NOT_NEGATIVE,
    "max_steps": AT_LEAST_ONE,
    # the training
    "steps_per_save": NOT_NEGATIVE,
    "steps_per_eval_batch": NOT_NEGATIVE,
    "steps_per_eval_image": NOT_NEGATIVE,
    "steps_per_eval_all_images": NOT_NEGATIVE,
    "steps_per_log": AT_LEAST_ONE,
    "max_buffer_size": AT_LEAST_ONE,
    "max_log_size": NOT_NEGATIVE,
    "threads": Bounds(1, MOST_THREADS),
    "machine.seed": Bounds(0, 2**32 - 1),
    "num_devices": AT_LEAST_ONE,
    "num_machines": AT_LEAST_ONE,
    "machine_rank": NOT_NEGATIVE,
}
"""Bounds of numbers by the name of the option, or its last two names; others only have to be
finite."""


def check_options(config: Any) -> None:
    """Raise PointSplatError, in one line with the option as it is typed, for the first number of a
    trainer's configuration that no training can have."""
    for path, value in _numbers(config, ()):
        bounds = RULES.get(".".join(path[-2:]), RULES.get(path[-1], FINITE))
        if not bounds.hold(value):
            raise PointSplatError(f"{_flag(path)} {value:g}: expected {bounds.text(value)}")
    for name, group in config.optimizers.items():
        schedule = group["scheduler"]
        warm_up = getattr(schedule, "warmup_steps", 0)
        if warm_up >= getattr(schedule, "max_steps", math.inf):
            raise PointSplatError(
                f"--optimizers.{name}.scheduler.warmup-steps {warm_up}: expected less than the "
                f"schedule's max-steps, {schedule.max_steps}"
            )
    if config.machine.num_machines > 1 and config.machine.dist_url == "auto":
        raise PointSplatError(
            f"--machine.num-machines {config.machine.num_machines}: expected --machine.dist-url "
            "with the address of the first machine, such as tcp://10.0.0.1:29500"
        )


def _numbers(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float]]:
    """Every number in a configuration with the names of the fields that lead to it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from _numbers(getattr(value, field.name), (*path, field.name))
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _numbers(part, (*path, str(name)))
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _numbers(part, path)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield path, value


def _flag(path: tuple[str, ...]) -> str:
    """An option as it is typed; those of dataparsers stand without the names of what they are
    in."""
    path = path[-1:] if "dataparser" in path else path
    return "--" + ".".join(name.replace("_", "-") for name in path)
