"""The training data of ``pointsplat make-refiner``: rooms, and scenes trained on them with varied settings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pointsplat_ns.nerfstudio_plugin.commands import train_refiner_command, train_scene_command

TRAIN_SEEDS = tuple(range(100, 116))
"""Seeds of the rooms that the refiner is trained on."""

UNSEEN_SEEDS = (50, 51, 52, 53)
"""Seeds of the rooms that the refiner is evaluated on."""

KEEP = 0.1
"""Share of the Gaussians that scenes are merged to in training."""


@dataclass(frozen=True)
class SceneSettings:
    """How the room of a seed is captured, and how a Splatfacto scene is trained on it."""

    seed: int
    frames: int
    width: int
    height: int
    steps: int
    seed_points: int
    densify_grad_thresh: float
    cull_alpha_thresh: float
    antialiased: bool
    scale_regularization: bool

    @property
    def name(self) -> str:
        return f"room{self.seed}"

    def train_command(self, data: Path, output: Path, timestamp: str) -> str:
        """The ``ns-train`` command that trains the scene."""
        options = {
            "pipeline.model.densify-grad-thresh": f"{self.densify_grad_thresh:.2g}",
            "pipeline.model.cull-alpha-thresh": self.cull_alpha_thresh,
            "pipeline.model.rasterize-mode": "antialiased" if self.antialiased else "classic",
            "pipeline.model.use-scale-regularization": self.scale_regularization,
        }
        return train_scene_command(data, output, self.name, self.steps, timestamp, self.seed_points, options)


def scene_settings(seed: int) -> SceneSettings:
    """The settings drawn for a room's seed; the same seed gives the same settings."""
    rng = np.random.default_rng([seed, 22])

    def log_uniform(low: float, high: float) -> float:
        return float(math.exp(rng.uniform(math.log(low), math.log(high))))

    width, height = ((256, 192), (240, 180), (256, 160), (208, 208))[rng.integers(4)]
    return SceneSettings(
        seed=seed,
        frames=int(rng.integers(45, 81)),
        width=width,
        height=height,
        steps=round(log_uniform(400, 1100)),
        seed_points=round(log_uniform(5_000, 40_000)),
        densify_grad_thresh=log_uniform(8e-4, 2.5e-3),
        cull_alpha_thresh=float(rng.choice((0.1, 0.05, 0.02))),
        antialiased=bool(rng.random() < 0.2),
        scale_regularization=bool(rng.random() < 0.3),
    )


def refiner_command(scenes: Path, output: Path, name: str, timestamp: str, size: str, steps: int, seed: int) -> str:
    """The ``ns-train`` command that trains the refiner."""
    options = {
        "pipeline.datamanager.supervision": "dense",
        "pipeline.datamanager.seed": seed,
        "pipeline.model.size": size,
        "pipeline.model.keep": KEEP,
        "pipeline.model.pixel-loss": "rmse",
        "pipeline.model.lpips-weight": 0.05,
        "rate-factor": 8,
        "pipeline.model.pruned-folder": scenes.parent / "pruned",
    }
    unseen = tuple(f"room{seed}" for seed in UNSEEN_SEEDS)
    return train_refiner_command(scenes, output, name, steps, timestamp, unseen, options)


def card_text(about: dict[str, Any], results: dict[str, Any], command: str, parameters: int) -> str:
    """A model card in Markdown, of the metadata of the weights, the results of ``ns-eval``, the command that trained
    the refiner, and the number of the network's parameters."""
    rows = []
    for name, scene in results["scenes"].items():
        if not scene["seen_in_training"]:
            rows += [_row(name, variant, scene[variant]) for variant in ("dense", "pruned", "refined")]
    rows += [_row("**mean of these**", v, results["average_unseen"][v]) for v in ("dense", "pruned", "refined")]
    return f"""# A refiner from built-in rooms

A network of {parameters:,} parameters ({results["settings"]["size"]}, dual-branch encoder) that repairs 3D Gaussian
Splatting scenes after they were merged to {100 * about["keep"]:g} % of their Gaussians. One forward pass, no photos.

- **Data:** {len(about["scenes"])} furnished rooms that the package makes itself ({about["scenes"][0]} to
  {about["scenes"][-1]}: size, furniture, textures, lights, path and size of the pictures all differ), each trained with
  `splatfacto-cpu` at settings of its own (`pointsplat_ns/nerfstudio_plugin/pointsplat/recipe.py`). No
  downloaded data.
- **Made by:** `{about["command"]}`
- **Training:** {about["steps"]:,} steps, each one scene and two views, against the dense scene's own renders. The
  command inside, in its output folder:

```
{command}
```

- **Results** on rooms that it was never trained on, held-out photos, {100 * about["keep"]:g} % kept:

| scene | variant | PSNR dB | SSIM | LPIPS | Gaussians |
|---|---|---|---|---|---|
{chr(10).join(rows)}

- **Limits:** trained on small rooms seen in small pictures. `pointsplat compact` compares renders before and after
  with those of the dense scene, and leaves the refinement out where it does not help.
- **Licence:** Apache-2.0, as the package.
"""


def _row(scene: str, variant: str, values: dict[str, Any]) -> str:
    lpips = "-" if values["lpips"] is None else f"{values['lpips']:.3f}"
    return (
        f"| {scene} | {variant} | {values['psnr']:.2f} | {values['ssim']:.3f} | {lpips} | {values['gaussians']:,.0f} |"
    )
