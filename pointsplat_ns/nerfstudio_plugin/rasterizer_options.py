"""The options of the rasterizer that both models of this plugin share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.backends import use_gsplat
from pointsplat_ns.rasterizer.compiled.blending import KERNELS

VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""Evaluation background of scenes trained with random backgrounds: the viewer's colour, as in Splatfacto."""


@dataclass
class RasterizerOptions:
    """Choice of the rasterizer and its speed"""

    backend: Literal["auto", "torch", "gsplat"] = "auto"
    """Rasterizer: torch runs everywhere, gsplat needs CUDA, auto takes gsplat if its CUDA kernels are available."""
    compiled: bool | None = None
    """Draw with compiled kernels on a CPU: None if there is a C++ compiler (it takes four seconds, once), True warns if
    there is none, False leaves it to torch, which is several times slower."""
    quality: Literal["exact", "balanced", "fast"] = "exact"
    """Accuracy that training gives up for speed (measured in docs/rasterizer.md). Evaluation is always exact."""

    def engine(self, device: torch.device) -> str:
        """What draws, in a line for the log."""
        if self.backend != "torch" and use_gsplat(self.backend, device):
            return "rasterizer: gsplat"
        if device.type != "cpu":
            return "rasterizer: torch"
        why = "as --pipeline.model.compiled is False" if self.compiled is False else KERNELS.why_missing
        return (
            f"rasterizer: torch, several times slower than compiled kernels: {why}" if why else "rasterizer: compiled"
        )

    def rasterize(self, training: bool, **arguments) -> tuple[Tensor, Tensor, dict]:
        """:func:`~pointsplat_ns.rasterizer.rasterization` with these options; exact outside of training."""
        quality = self.quality if training else "exact"
        return rasterization(**arguments, backend=self.backend, compiled=self.compiled, quality=quality)
