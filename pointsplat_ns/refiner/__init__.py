"""The refiner: dual-branch encoder, Point Transformer V3 in plain torch, residual heads."""

from pointsplat_ns.refiner.config import PRESETS, RefinerConfig, RefinerConfigError, preset
from pointsplat_ns.refiner.refiner import Refiner
from pointsplat_ns.refiner.structure import Structure
from pointsplat_ns.refiner.weights import WeightsError, read_metadata, read_refiner, save_refiner

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
