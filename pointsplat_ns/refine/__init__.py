"""The refiner: dual-branch encoder, Point Transformer V3 in plain torch, residual heads."""

from pointsplat_ns.refine.config import PRESETS, RefinerConfig, RefinerConfigError, preset
from pointsplat_ns.refine.refiner import Refiner
from pointsplat_ns.refine.structure import Structure
from pointsplat_ns.refine.weights import WeightsError, read_metadata, read_refiner, save_refiner

__all__ = [
    "PRESETS",
    "Refiner",
    "RefinerConfig",
    "RefinerConfigError",
    "Structure",
    "WeightsError",
    "preset",
    "read_metadata",
    "read_refiner",
    "save_refiner",
]
