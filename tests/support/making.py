"""What several test modules make: scenes, settings of a training, runs whose data is gone."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import torch

from pointsplat_ns.gaussians import Gaussians

REPOSITORY = Path(__file__).resolve().parents[2]

SHARED_DATA = REPOSITORY.parent / "shared" / "data"
"""Real captures, splats and weights that tests read in place; they skip where it is absent."""


def same(a: Gaussians, b: Gaussians) -> bool:
    """Whether two scenes are equal to the bit."""
    return all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))


def ball(
    n: int, degree: int = 1, seed: int = 0, log_size: float = math.log(0.25), opacity: float = 2.0, bright: float = 0.0
) -> Gaussians:
    """The inside of a ball of radius 2, covered with coloured blobs.

    Args:
        n: how many.
        degree: of SH.
        seed: the same seed gives the same ball.
        log_size: mean log of their standard deviations.
        opacity: mean logit.
        bright: added to the constant SH coefficients.
    """
    generator = torch.Generator().manual_seed(seed)
    place = torch.randn(n, 3, generator=generator)
    place = 2 * place / place.norm(dim=1, keepdim=True)
    return Gaussians(
        means=place,
        scales=torch.full((n, 3), log_size) + 0.2 * torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        opacities=opacity + torch.randn(n, 1, generator=generator),
        features_dc=bright + torch.sin(2 * place),
        features_rest=0.05 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator),
    )


def small_config(data: Path, output_dir: Path, steps: int, **model):
    """The method as registered, at a size for tests; no LPIPS in the loss, so that nothing is downloaded."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config

    config = pointsplat_config()
    config.machine.device_type = "cpu"
    config.output_dir, config.max_num_iterations, config.experiment_name = output_dir, steps, "refiner"
    config.pipeline.datamanager.data = config.data = data
    for name, value in {"size": "tiny", "keep": 0.5, "by": "paper", "lpips_weight": 0.0, **model}.items():
        setattr(config.pipeline.model, name, value)
    config.set_timestamp()
    return config


def without_data(runs: Path, folder: Path) -> Path:
    """A copy of runs, whose data is where nobody finds it: below ``gone_from_here``."""
    shutil.copytree(runs, folder)
    for config in folder.rglob("config.yml"):
        config.write_text(config.read_text().replace("- replica", "- gone_from_here"))
    return folder
