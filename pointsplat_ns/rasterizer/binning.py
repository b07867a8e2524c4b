"""Chooses the code that finds the tiles of Gaussians: torch (:mod:`~pointsplat_ns.rasterizer.ellipses`), or kernels
where they were built (:mod:`~pointsplat_ns.rasterizer.compiled.tiles`)."""

from __future__ import annotations

from types import ModuleType

from torch import Tensor

from pointsplat_ns.rasterizer import ellipses
from pointsplat_ns.rasterizer.compiled import tiles as compiled_tiles


def engine_of(compiled: bool | None, *tensors: Tensor) -> ModuleType:
    """The module with ``ellipses_of`` and ``pairs_of`` for these tensors of projected Gaussians; ``compiled`` as for
    :func:`~pointsplat_ns.rasterization`."""
    return compiled_tiles if compiled_tiles.KERNELS.usable_for(compiled, *tensors) else ellipses
