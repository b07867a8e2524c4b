"""The options of the rasterizer that both models of this plugin share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.backends import use_gsplat
from pointsplat_ns.rasterizer.compiled import blending, colors, projection, tiles
from pointsplat_ns.system.kernels import Kernels

VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""Evaluation background of scenes trained with random backgrounds: the viewer's colour, as in Splatfacto."""


@dataclass
class RasterizerOptions:
    """Choice of the rasterizer and its speed"""

    backend: Literal["auto", "torch", "gsplat"] = "auto"
    """Rasterizer: torch runs everywhere, gsplat needs CUDA, auto takes gsplat if its CUDA kernels are available."""
    compiled: bool | None = None
    """Draw with compiled kernels on a CPU: None if they were built, True warns if they were not, False leaves it to
    torch, which is several times slower."""
    quality: Literal["exact", "balanced", "fast"] = "exact"
    """Accuracy that training gives up for speed (see docs/rasterizer.md). Evaluation is always exact."""

    def kernels(self) -> dict[str, Kernels]:
        """All compiled kernels that a training uses on a CPU, by what they do."""
        return {
            "projection": projection.KERNELS,
            "colours": colors.KERNELS,
            "lists of tiles": tiles.KERNELS,
            "blending": blending.KERNELS,
        }

    def engine(self, device: torch.device) -> str:
        """Name of the rasterizer in use, a line for the log."""
        if self.backend != "torch" and use_gsplat(self.backend, device):
            return "rasterizer: gsplat"
        if device.type != "cpu":
            return "rasterizer: torch"
        if self.compiled is False:
            missing = dict.fromkeys(self.kernels(), "as --pipeline.model.compiled is False")
        else:
            missing = {what: why for what, kernels in self.kernels().items() if (why := kernels.why_missing)}
        if not missing:
            return "rasterizer: compiled"
        why = "; ".join(dict.fromkeys(missing.values()))
        if len(missing) == len(self.kernels()):
            return f"rasterizer: torch, several times slower than compiled kernels: {why}"
        return f"rasterizer: compiled, but torch does {', '.join(missing)}, which is slower: {why}"

    def rasterize(self, training: bool, **arguments) -> tuple[Tensor, Tensor, dict]:
        """:func:`~pointsplat_ns.rasterizer.rasterization` with these options; exact outside of training."""
        quality = self.quality if training else "exact"
        return rasterization(**arguments, backend=self.backend, compiled=self.compiled, quality=quality)
