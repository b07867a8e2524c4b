"""Distributions of opacity and size in a scene, as quantiles and as a plot."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import replacing
from pointsplat_ns.pruning.scores import log_volume


def size_quantiles(scene: Gaussians) -> list[float]:
    """The 10, 50 and 90 % quantiles of the largest standard deviation, scene units; NaN for an empty scene."""
    return _quantiles(scene.stds.amax(dim=1))


def opacity_quantiles(scene: Gaussians) -> list[float]:
    """The 10, 50 and 90 % quantiles of opacity; NaN for an empty scene."""
    return _quantiles(scene.alphas)


def _quantiles(values: Tensor) -> list[float]:
    """The 10, 50 and 90 % quantiles of the finite values."""
    shares = (0.1, 0.5, 0.9)
    ranked = values.detach().double()[values.isfinite()].sort().values
    if len(ranked) == 0:
        return [math.nan] * len(shares)
    return [float(ranked[round(q * (len(ranked) - 1))]) for q in shares]


def plot_distributions(scenes: dict[str, Gaussians], path: Path | str) -> None:
    """Plot the distributions of opacity (left) and log-volume (right), as in Figure 4 of the paper.

    Args:
        scenes: name in the legend, such as "before" and "after" -> scene.
        path: the PNG file to write.

    Raises:
        SceneError: if ``path`` cannot be written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     picture = Path(folder) / "kept.png"
        ...     ps.plot_distributions({"before": room, "after": ps.prune(room, 0.1, by="opacity")}, picture)
        ...     picture.is_file()
        True
    """
    from matplotlib.figure import Figure

    opacities = {name: scene.alphas[scene.usable()].detach().cpu() for name, scene in scenes.items()}
    volumes = {name: log_volume(scene)[scene.usable()].detach().cpu() / math.log(10) for name, scene in scenes.items()}
    volumes = {name: values[values.isfinite()] for name, values in volumes.items()}
    every = torch.cat(list(volumes.values()))
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    figure = Figure(figsize=(11, 4), layout="constrained")
    panels = (
        (opacities, (0.0, 1.0), "opacity"),
        (volumes, (low, high if high > low else low + 1.0), "log10 of the volume, scene units cubed"),
    )
    for axis, (values, span, label) in zip(figure.subplots(1, 2), panels, strict=True):
        for name, numbers in values.items():
            counts = torch.histc(numbers.double(), bins=60, min=span[0], max=span[1])
            edges = torch.linspace(span[0], span[1], 61)
            axis.stairs(counts.numpy(), edges.numpy(), fill=True, alpha=0.5, label=f"{name}: {len(scenes[name]):,}")
        axis.set_xlabel(label)
        axis.set_ylabel("Gaussians")
        axis.set_yscale("symlog", linthresh=1)
        axis.legend()
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png")
