"""Makes scenes smaller: pruning methods, budgets, SH bands."""

from pointsplat_ns.pruning.budget import (
    Keep,
    Megabytes,
    WithinPsnr,
    found_by_trying,
    parse_keep,
    resolve_keep,
)
from pointsplat_ns.pruning.methods import (
    METHODS,
    Method,
    PruneSettings,
    method_named,
    need_usable,
    prune,
    score_of,
)
from pointsplat_ns.pruning.paper import select
from pointsplat_ns.pruning.sh_bands import band_energies, cut_sh, energy_lost
from pointsplat_ns.scene.ply import ply_bytes

__all__ = [
    "METHODS",
    "Keep",
    "Megabytes",
    "Method",
    "PruneSettings",
    "WithinPsnr",
    "band_energies",
    "cut_sh",
    "energy_lost",
    "found_by_trying",
    "method_named",
    "need_usable",
    "parse_keep",
    "ply_bytes",
    "prune",
    "resolve_keep",
    "score_of",
    "select",
]
