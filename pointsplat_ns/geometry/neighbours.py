"""Nearest neighbours among points in space."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The nearest points of every point, the nearest first; a point is its own nearest.

    Where several points coincide, any of them may come first. Runs on the CPU, with as many threads as torch uses.

    Args:
        points: (N, D), finite, any floating type and device.
        k: number of neighbours, including the point itself, at least 1.

    Returns:
        Distances (N, K) float64 and indices (N, K) int64, on the CPU, with K = min(k, N).

    Example:
        >>> distances, indices = nearest(torch.tensor([[0.0], [1.0], [3.0]]), 2)
        >>> distances.tolist(), indices.tolist()
        ([[0.0, 1.0], [0.0, 1.0], [0.0, 2.0]], [[0, 1], [1, 0], [2, 1]])
    """
    distances, indices, _ = nearest_and_walk(points, k)
    return distances, indices


def nearest_and_walk(points: Tensor, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`nearest`, and the indices of all points, (N,) int64, in the order of the search tree's leaves. Points
    next to each other in that order are close in space, even where more than k points coincide."""
    from scipy.spatial import cKDTree

    n = len(points)
    if n == 0:
        nothing = torch.empty(0, 0)
        return nothing.double(), nothing.long(), nothing.long().view(0)
    array = points.detach().double().cpu().numpy()
    tree = cKDTree(array, balanced_tree=False)
    # The ranks are listed, because k = 1 would drop their axis.
    ranks = range(1, min(k, n) + 1)
    distances, indices = tree.query(array, k=list(ranks), workers=torch.get_num_threads())
    return torch.from_numpy(distances), torch.from_numpy(indices).long(), torch.from_numpy(tree.indices).long()
