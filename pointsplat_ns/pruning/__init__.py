"""Making a scene smaller from its own attributes alone: scores that choose what to keep, merging, budgets, SH bands."""

from pointsplat_ns.pruning.budget import AUTO_PSNR, Keep, Megabytes, WithinPsnr, parse_keep, ply_bytes, resolve_keep
from pointsplat_ns.pruning.compact import MERGE, METHODS, compact
from pointsplat_ns.pruning.coverage import coverage_score
from pointsplat_ns.pruning.merging import Merged as Merged
from pointsplat_ns.pruning.merging import merge as merge
from pointsplat_ns.pruning.scores import paper_score
from pointsplat_ns.pruning.select import SCORES, WEIGHTED, Pruned, need_usable, prune, select
from pointsplat_ns.pruning.sh_bands import band_energies, cut_sh, energy_lost

__all__ = [
    "AUTO_PSNR",
    "MERGE",
    "METHODS",
    "SCORES",
    "WEIGHTED",
    "Keep",
    "Megabytes",
    "Pruned",
    "WithinPsnr",
    "band_energies",
    "compact",
    "coverage_score",
    "cut_sh",
    "energy_lost",
    "need_usable",
    "paper_score",
    "parse_keep",
    "ply_bytes",
    "prune",
    "resolve_keep",
    "select",
]
