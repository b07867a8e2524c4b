"""Nearest neighbours in plain torch, on any device: exact, in the precision of the points.

The tree halves the points recursively, across the widest axis of their box, down to leaves of a few
points. A query first visits one leaf, whose distances are upper bounds. It then descends the tree,
level by level, into all boxes within these bounds. Many queries process each level together. The
depth of the tree does not depend on the distribution of the points, and coincident points are not
searched again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import numbers


class BoxTree:
    """A tree of points.

    Args:
        points: (N, 3), finite, float32 or float64, on any device; N is at least 1.
        k: maximum number of neighbours per query. A leaf has at least as many points, and at least
            8.
    """

    PAIRS_AT_ONCE = 1 << 19
    """Number of pairs of query and box that are searched at a time; 0.7 GB in a leaf."""

    def __init__(self, points: Tensor, k: int):
        n = len(points)
        device = points.device
        self.order = numbers(n, device)
        """Indices (N,) of the points in tree order, which puts near points together."""
        self._boxes: list[
            tuple[Tensor, Tensor]
        ] = []  # lowest and highest corners (2^level, 3) of each level
        while True:
            level = len(self._boxes)
            # halves of equal size, up to one point
            self._starts = ((numbers((1 << level) + 1, device) * n) + (1 << level) - 1) >> level
            self._points = points[self.order]
            self._width = (n >> level) + 1
            inside = self._points[self._spots(numbers(1 << level, device))]
            self._boxes.append((inside.amin(1), inside.amax(1)))
            if n >> level < 2 * max(8, k):
                break
            low, high = self._boxes[-1]
            part = (numbers(n, device) << level) // n
            along = (
                self._points.gather(1, (high - low).argmax(1)[part, None])[:, 0]
                .sort(stable=True)
                .indices
            )
            self.order = self.order[along[part[along].sort(stable=True).indices]]

    def nearest(self, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The points nearest to each query, nearest first.

        Args:
            queries: (m, 3), finite, of the dtype and on the device of the points.
            k: number of neighbours, at least 1, and at most N and that of the tree.

        Returns:
            Distances (m, k), and indices (m, k) int64. Points at the same distance are in any
            order.
        """
        found = [self._nearest(some, k) for some in queries.split(self.PAIRS_AT_ONCE // 16)]
        squares, spots = (torch.cat(parts) for parts in zip(*found, strict=True))
        return squares.sqrt(), self.order[spots]

    def _nearest(self, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Squared distances (m, k), and positions (m, k) in tree order."""
        m = len(queries)
        first = numbers(m, queries.device).mul_(0)
        for level in range(1, len(self._boxes)):
            left, right = (self._to_boxes(level, queries, 2 * first + side) for side in (0, 1))
            first = 2 * first + (right < left)
        squares, spots = self._in_leaves(queries, first)
        squares, slots = squares.sort(dim=1, stable=True)
        squares, spots, most = squares[:, :k], spots.gather(1, slots[:, :k]), squares[:, k - 1]

        query = numbers(m, queries.device)
        box = torch.zeros_like(first)
        for level in range(1, len(self._boxes)):
            query = query.repeat_interleave(2)
            box = torch.stack([2 * box, 2 * box + 1], dim=1).flatten()
            nearer = (self._to_boxes(level, queries[query], box) < most[query]).nonzero()[:, 0]
            query = query[nearer]
            box = box[nearer]
            if m > 1 and len(query) > self.PAIRS_AT_ONCE:
                halves = [self._nearest(half, k) for half in queries.split(-(-m // 2))]
                return torch.cat([half[0] for half in halves]), torch.cat(
                    [half[1] for half in halves]
                )
        others = (box != first[query]).nonzero()[:, 0]
        query = query[others]
        box = box[others]
        more, where = self._in_leaves(queries[query], box)
        row, slot = (more < most[query, None]).nonzero(as_tuple=True)

        owners = torch.cat([numbers(m, queries.device).repeat_interleave(k), query[row]])
        squares = torch.cat([squares.flatten(), more[row, slot]])
        spots = torch.cat([spots.flatten(), where[row, slot]])
        order = squares.sort(stable=True).indices
        order = order[owners[order].sort(stable=True).indices]  # by query, then by distance
        counts = torch.zeros_like(first).scatter_add_(0, owners, torch.ones_like(owners))
        best = order[(counts.cumsum(0) - counts)[:, None] + numbers(k, queries.device)]
        return squares[best], spots[best]

    def _to_boxes(self, level: int, queries: Tensor, box: Tensor) -> Tensor:
        """Squared distances (p,) of queries (p, 3) from boxes (p,) of a level; 0 inside."""
        low, high = self._boxes[level]
        return torch.maximum(low[box] - queries, queries - high[box]).clamp_min_(0).square().sum(1)

    def _in_leaves(self, queries: Tensor, leaf: Tensor) -> tuple[Tensor, Tensor]:
        """Squared distances (p, w) of queries (p, 3) from the points of leaves (p,), infinite for
        padding, and the positions (p, w) of these points in tree order."""
        spots = self._spots(leaf)
        squares = (queries[:, None] - self._points[spots]).square().sum(2)
        squares[:, 1:].masked_fill_(spots[:, 1:] == spots[:, :-1], torch.inf)
        return squares, spots

    def _spots(self, part: Tensor) -> Tensor:
        """Positions (p, w) in tree order of the points in parts (p,) of the last level, padded with
        the last position."""
        spots = self._starts[part][:, None] + numbers(self._width, part.device)
        return torch.minimum(spots, self._starts[part + 1][:, None] - 1)
