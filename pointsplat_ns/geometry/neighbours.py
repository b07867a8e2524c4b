"""Nearest neighbours among points in space: by a compiled tree of boxes (``neighbours.cpp``), else by scipy's k-d tree.

Both are exact, in float64. They may differ in the order of neighbours at equal distances.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pointsplat_ns.system.kernels import SEVERAL, Kernels, on_threads
from pointsplat_ns.system.pieces import CHUNK
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.system.threads import most_threads

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@dataclass(frozen=True)
class TreeSettings:
    """Sizes of the search for neighbours."""

    queries_at_once: int = 1 << 17
    """Number of points asked for at once, to save memory."""
    lanes: int = 8
    """Points in a leaf of the compiled tree, and children of a node."""
    most_compiled: int = 32
    """Largest number of neighbours that the compiled tree finds."""


TREE = TreeSettings()


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
        nothing = torch.empty(0, 0, **FLOATS)
        return nothing.double(), nothing.long()
    array = points.detach().double().cpu().numpy()
    # The ranks are listed, because k = 1 would drop their axis.
    ranks = list(range(1, min(k, n) + 1))
    tree = cKDTree(array, balanced_tree=False)
    distances, indices = tree.query(array, k=ranks, workers=most_threads())
    return torch.from_numpy(distances), torch.from_numpy(indices).long()


def other_neighbours(points: Tensor, k: int, compiled: bool | None = None) -> Tensor:
    """The nearest other points of every point, without their distances, in little memory.

    Where more than k points coincide, their nearest ones are the same few. So each of them has, in place of its last
    two, those before and after it in the order of the search tree, where no two coincident points are far apart.

    Args:
        points: (N, 3) float64, finite, on the CPU.
        k: number of neighbours, at least 2.
        compiled: False leaves it to scipy; True warns if the kernel could not be compiled.

    Returns:
        Indices (N, k) int32, the nearest first; a point's own index stands for none.
    """
    if k <= TREE.most_compiled and len(points) and KERNELS.usable(compiled):
        tree = PointTree(points)
        near, walk = tree.others(k), tree.order
    else:
        near, walk = _others_by_scipy(points, k)
    own = torch.arange(len(points), dtype=torch.int32, device="cpu")
    same = [
        (last >= 0) & (points[last.long()] == points[these]).all(1)
        for last, these in zip(near[:, k - 1].split(CHUNK), own.split(CHUNK), strict=True)
    ]
    crowd = torch.cat(same).nonzero()[:, 0] if same else own.long()
    if len(crowd):
        before, after = torch.empty_like(walk), torch.empty_like(walk)
        before[walk], after[walk] = walk.roll(1), walk.roll(-1)
        near[crowd, k - 2], near[crowd, k - 1] = before[crowd].to(torch.int32), after[crowd].to(torch.int32)
    return near.where(near >= 0, own[:, None]) if bool((near[:, -1] < 0).any()) else near


def _others_by_scipy(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Nearest other points (N, k) int32, -1 for none, and the order (N,) of the points in the search tree."""
    from scipy.spatial import cKDTree

    n, array = len(points), points.numpy()
    tree = cKDTree(array, balanced_tree=False)
    near = torch.full((n, k), -1, dtype=torch.int32, device="cpu")
    ranks = list(range(1, min(k + 1, n) + 1))
    for these in torch.arange(n, **INDICES).split(TREE.queries_at_once):
        _, found = tree.query(array[these[0] : these[-1] + 1], k=ranks, workers=most_threads())
        indices = torch.from_numpy(found)
        # The point itself is the first, or, among coincident ones, anywhere or missing: the first takes its place.
        indices = indices.where(indices != these[:, None], indices[:, :1])
        near[these, : len(ranks) - 1] = indices[:, 1:].to(torch.int32)
    return near, torch.from_numpy(tree.indices.copy())  # newer releases of scipy give what must not be written to


class NearestOf:
    """The nearest points of other places.

    Args:
        points: (N, 3) float64, finite, on the CPU; N is at least 1.
        k: number of neighbours.
        compiled: as for :func:`other_neighbours`.
    """

    def __init__(self, points: Tensor, k: int, compiled: bool | None = None):
        self._k, self._points = min(k, len(points)), points
        suited = self._k <= TREE.most_compiled and KERNELS.usable(compiled)
        self._tree = PointTree(points) if suited else None

    def __call__(self, queries: Tensor, near: Tensor) -> Tensor:
        """The nearest points of some places.

        Args:
            queries: (m, 3) float64, finite, on the CPU.
            near: (m,) int64, for each query the index of a point; the nearer, the faster.

        Returns:
            Indices (m, min(k, N)) int32, the nearest first.
        """
        if self._tree is not None:
            return self._tree.nearest(queries, near, self._k)
        ranks = list(range(1, self._k + 1))
        return torch.from_numpy(self._by_scipy.query(queries.numpy(), k=ranks, workers=most_threads())[1]).to(
            torch.int32
        )

    @functools.cached_property
    def _by_scipy(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self._points.numpy(), balanced_tree=False)


class PointTree:
    """A tree of boxes over points, by the compiled kernel.

    Args:
        points: (N, 3) float64, finite, on the CPU; N is at least 1.
    """

    def __init__(self, points: Tensor):
        count = len(points)
        self.order = torch.arange(count, **INDICES)
        """Indices (N,) int64 of the points as the leaves hold them."""
        sizes = [-(-count // TREE.lanes)]  # leaves, then the nodes of each level
        while len(sizes) < 2 or sizes[-1] > 1:
            sizes.append(-(-sizes[-1] // TREE.lanes))
        starts = [sum(sizes[1:level]) for level in range(1, len(sizes))]
        self._tree = KERNELS.structs["Tree"](
            points=points.contiguous(), order=self.order, count=count, levels=len(starts),
            starts=(*starts, *[0] * (16 - len(starts))),
            leaves=torch.empty(sizes[0], 3, TREE.lanes, **DOUBLES),
            boxes=torch.empty(sum(sizes[1:]), 6, TREE.lanes, **DOUBLES),
        )  # fmt: skip
        KERNELS.library.pointsplat_order(self._tree)
        self._run(count, KERNELS.library.pointsplat_leaves, self._tree)
        for level in range(len(starts)):
            self._run(count, KERNELS.library.pointsplat_boxes, self._tree, level)

    def others(self, k: int) -> Tensor:
        """The nearest other points (N, k) int32 of every point, the nearest first; -1 for none. ``k`` is at most
        ``TREE.most_compiled``."""
        return self._search(len(self.order), k)

    def nearest(self, queries: Tensor, near: Tensor, k: int) -> Tensor:
        """As :class:`NearestOf`, for at most ``TREE.most_compiled`` neighbours."""
        return self._search(len(queries), k, queries=queries.contiguous(), leaves=self._leaves[near])

    @functools.cached_property
    def _leaves(self) -> Tensor:
        """The leaf (N,) int64 of each point."""
        leaves = torch.empty_like(self.order)
        leaves[self.order] = torch.arange(len(self.order), **INDICES) // TREE.lanes
        return leaves

    def _search(self, count: int, k: int, **where: Tensor) -> Tensor:
        found = torch.empty(count, k, dtype=torch.int32, device="cpu")
        search = KERNELS.structs["Search"](tree=self._tree, count=count, wanted=k, found=found, **where)
        self._run(count, KERNELS.library.pointsplat_nearest, search)
        return found

    @staticmethod
    def _run(count: int, *call: object) -> None:
        function, *arguments = call
        on_threads(count >= SEVERAL, function, *arguments, threads=most_threads())  # type: ignore[arg-type]


def _as_torch() -> bool:
    """Whether the kernel finds the neighbours of some points as torch does by brute force."""
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(0), **DOUBLES)
    apart = (points[:, None] - points).square().sum(2).fill_diagonal_(torch.inf)
    tree, own = PointTree(points), torch.arange(len(points), **INDICES)
    near = apart.sort(dim=1).indices[:, :5].to(torch.int32)
    return torch.equal(tree.others(5), near) and torch.equal(tree.nearest(points, own, 1)[:, 0].long(), own)


KERNELS = Kernels("the search for neighbours", Path(__file__).with_name("neighbours.cpp"), _as_torch)
