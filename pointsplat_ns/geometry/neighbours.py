"""Nearest neighbours among points in space."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.system.threads import most_threads

CHUNK = 1 << 17
"""Number of points asked for at once, to save memory."""


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
    from scipy.spatial import cKDTree

    n = len(points)
    if n == 0:
        nothing = torch.empty(0, 0)
        return nothing.double(), nothing.long()
    array = points.detach().double().cpu().numpy()
    # The ranks are listed, because k = 1 would drop their axis.
    ranks = list(range(1, min(k, n) + 1))
    tree = cKDTree(array, balanced_tree=False)
    distances, indices = tree.query(array, k=ranks, workers=most_threads())
    return torch.from_numpy(distances), torch.from_numpy(indices).long()


def other_neighbours(points: Tensor, k: int) -> Tensor:
    """The nearest other points of every point, without their distances, in little memory.

    Where more than k points coincide, their nearest ones are the same few. So each of them has, in place of its last
    two, its neighbours in the order of the search tree's leaves, where no two coincident points are far apart.

    Args:
        points: (N, 3) float64, finite, on the CPU.
        k: number of neighbours, at least 2.

    Returns:
        Indices (N, k) int32; a point's own index stands for none.
    """
    from scipy.spatial import cKDTree

    n = len(points)
    array = points.numpy()
    tree = cKDTree(array, balanced_tree=False)
    walk = torch.from_numpy(tree.indices.copy())  # newer releases of scipy give what must not be written to
    near = torch.arange(n, dtype=torch.int32)[:, None].repeat(1, k)
    ranks = list(range(1, min(k + 1, n) + 1))
    crowded = []
    for these in torch.arange(n).split(CHUNK):
        distances, found = tree.query(array[these[0] : these[-1] + 1], k=ranks, workers=most_threads())
        indices = torch.from_numpy(found)
        # The point itself is the first, or, among coincident ones, anywhere or missing: the first takes its place.
        indices = indices.where(indices != these[:, None], indices[:, :1])
        near[these, : len(ranks) - 1] = indices[:, 1:].to(torch.int32)
        crowded.append(torch.from_numpy(distances[:, -1] == 0) & (len(ranks) == k + 1))
    crowd = torch.cat(crowded)
    if bool(crowd.any()):
        before, after = torch.empty_like(walk), torch.empty_like(walk)
        before[walk], after[walk] = walk.roll(1), walk.roll(-1)
        near[crowd, k - 2], near[crowd, k - 1] = before[crowd].to(torch.int32), after[crowd].to(torch.int32)
    return near
