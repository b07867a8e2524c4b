"""The refiner: dual-branch encoder, Point Transformer V3 in plain torch, residual heads."""

from pointsplat_ns.refinement.config import (
    PRESETS,
    RefinerConfig,
    RefinerConfigError,
    refiner_preset,
)
from pointsplat_ns.refinement.refiner import Refiner
from pointsplat_ns.refinement.structure import Structure
from pointsplat_ns.refinement.weights import WeightsError, read_metadata, read_refiner, save_refiner

__all__ = [
    "PRESETS",
    "Refiner",
    "RefinerConfig",
    "RefinerConfigError",
    "Structure",
    "WeightsError",
    "refiner_preset",
    "read_metadata",
    "read_refiner",
    "save_refiner",
]
