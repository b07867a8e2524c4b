"""How the models of this plugin draw: the options that the rasterizer obeys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from pointsplat_ns.rasterizer import rasterization


@dataclass
class RasterizerOptions:
    """What draws, and how fast"""

    backend: Literal["auto", "torch", "gsplat"] = "auto"
    """What draws: torch runs everywhere; gsplat needs CUDA; auto takes gsplat where its kernels are there."""
    compiled: bool = False
    """Blend with kernels made by torch.compile: faster on a CPU with a C++ compiler, after a minute of compiling at the
    first step (once; the result is kept on disk). Where that fails a warning says why, and training goes on without."""
    quality: Literal["exact", "balanced", "fast"] = "exact"
    """What training may give up for speed (docs/rasterizer.md says how much); evaluation is always exact."""

    def rasterize(self, training: bool, **arguments) -> tuple[Tensor, Tensor, dict]:
        """:func:`~pointsplat_ns.rasterizer.rasterization` by these options; exact outside of training."""
        quality = self.quality if training else "exact"
        return rasterization(**arguments, backend=self.backend, compiled=self.compiled, quality=quality)
