"""Merging: replaces a scene by fewer Gaussians that look the same, from its 3D attributes alone.

In each round, pairs of neighbours are replaced by one Gaussian each. README.md in this folder
explains the steps, in the order of :mod:`~pointsplat_ns.pruning.merging.rounds`.
"""

from pointsplat_ns.pruning.merging.rounds import Merged, Merger, merge, merge_levels
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings

__all__ = ["MERGING", "MergeSettings", "Merged", "Merger", "merge", "merge_levels"]
