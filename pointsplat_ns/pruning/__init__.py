"""Choosing the Gaussians to keep, from the attributes of the scene alone."""

from pointsplat_ns.pruning.budget import parse_keep, resolve_keep
from pointsplat_ns.pruning.scores import SCORES, paper_score
from pointsplat_ns.pruning.select import Pruned, prune, select

__all__ = ["SCORES", "Pruned", "paper_score", "parse_keep", "prune", "resolve_keep", "select"]
