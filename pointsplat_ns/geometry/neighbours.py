"""Nearest neighbours of points: exact, in float64; on a CPU with compiled kernels
(``point_tree.cpp``), or without them with scipy's k-d tree."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from pointsplat_ns.geometry.box_tree import BoxTree
from pointsplat_ns.system.kernels import (
    DOUBLE_POINTER,
    INT32_POINTER,
    INT64_POINTER,
    KERNELS,
    LANES,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, numbers
from pointsplat_ns.system.threads import most_threads, parallel_for


class PointTreeStruct(Struct):
    """``PointTree`` of ``point_tree.cpp``, which documents its members."""

    members = {
        "points": DOUBLE_POINTER,
        "count": ctypes.c_int64,
        "order": INT32_POINTER,
        "leaves": DOUBLE_POINTER,
        "boxes": DOUBLE_POINTER,
    }
    _fields_ = c_fields(members)


class NearestPointsStruct(Struct):
    """``NearestPoints`` of ``point_tree.cpp``, which documents its members."""

    members = {
        "tree": PointTreeStruct,
        "queries": DOUBLE_POINTER,
        "queried": ctypes.c_int64,
        "wanted": ctypes.c_int64,
        "distances": DOUBLE_POINTER,
        "indices": INT32_POINTER,
    }
    _fields_ = c_fields(members)


most_nearest_kernel = Function("pointsplat_most_nearest", result=ctypes.c_int64)
build_tree_kernel = Function("pointsplat_build_tree", PointTreeStruct)
nearest_kernel = Function("pointsplat_nearest", NearestPointsStruct, INT64_POINTER)

QUERIES_AT_ONCE = 1 << 14
"""Number of points per search in a thread, to limit memory; eight times as many on a GPU."""


def nearest(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The nearest points of every point, nearest first; a point is its own nearest.

    Coincident points are in any order. Runs on the CPU, with as many threads as torch uses.

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
    n = len(points)
    if n == 0:
        nothing = torch.empty(0, 0, **FLOATS)
        return nothing.double(), nothing.long()
    places = points.detach().double().cpu()
    return _cpu_tree(places, min(k, n)).nearest(places, min(k, n))


def import_tree() -> None:
    """Import scipy in advance where its tree is used, because it takes long."""
    if not KERNELS.usable(None):
        import scipy.spatial  # noqa: F401


class _KernelTree:
    """The twin of :class:`~pointsplat_ns.geometry.box_tree.BoxTree` with compiled kernels, for at
    most :data:`most_nearest_kernel` neighbours of points (N, 3) float64."""

    def __init__(self, points: Tensor):
        n = len(points)
        leaves = -(-n // LANES)
        self._tree = PointTreeStruct(
            points=points.contiguous(),
            count=n,
            order=torch.empty(n, dtype=torch.int32, device="cpu"),
            leaves=torch.empty(leaves, 3, LANES, **DOUBLES),
            boxes=torch.empty(2 * leaves - 1, 6, **DOUBLES),
        )
        build_tree_kernel(self._tree)

    @property
    def order(self) -> Tensor:
        order: Tensor = self._tree.references["order"]
        return order.long()

    def nearest(self, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
        distances = torch.empty(len(queries), k, **DOUBLES)
        indices = torch.empty(len(queries), k, dtype=torch.int32, device="cpu")
        task = NearestPointsStruct(
            tree=self._tree,
            queries=queries.contiguous(),
            queried=len(queries),
            wanted=k,
            distances=distances,
            indices=indices,
        )
        on_threads(len(queries) >= SEVERAL, nearest_kernel, task)
        return distances, indices.long()


class _ScipyTree:
    """scipy's twin of :class:`~pointsplat_ns.geometry.box_tree.BoxTree`, points (N, D) float64."""

    def __init__(self, points: Tensor):
        from scipy.spatial import cKDTree

        self._tree = cKDTree(points.numpy(), balanced_tree=False)

    @property
    def order(self) -> Tensor:
        # newer releases return a read-only array
        return torch.from_numpy(self._tree.indices.copy())

    def nearest(self, queries: Tensor, k: int) -> tuple[Tensor, Tensor]:
        # A list of ranks, because k = 1 would drop the axis.
        distances, indices = self._tree.query(
            queries.numpy(), k=list(range(1, k + 1)), workers=most_threads()
        )
        return torch.from_numpy(distances), torch.from_numpy(indices).long()


def _cpu_tree(points: Tensor, k: int) -> _KernelTree | _ScipyTree:
    """A search tree of points (N, D) float64 on a CPU for at most ``k`` neighbours."""
    if points.shape[1] == 3 and KERNELS.usable(None) and k <= most_nearest_kernel():
        return _KernelTree(points)
    return _ScipyTree(points)


def _tree_of(points: Tensor, k: int) -> _KernelTree | _ScipyTree | BoxTree:
    """A search tree of points (N, 3) for at most ``k`` neighbours."""
    return _cpu_tree(points, k) if points.device.type == "cpu" else BoxTree(points, k)


def other_neighbours(points: Tensor, k: int) -> Tensor:
    """The nearest other points of every point, without distances, in little memory.

    If more than k points coincide, all have the same nearest few. So each of them gets, in place of
    its last two neighbours, its predecessor and successor in tree order, where coincident points
    are close together.

    Args:
        points: (N, 3) float64, finite, on any device.
        k: number of neighbours, at least 2.

    Returns:
        Indices (N, k) int32 on that device, nearest first; a point's own index means none.
    """
    own = numbers(len(points), points.device)
    near = own.to(torch.int32)[:, None].repeat(1, k)
    if not len(points):
        return near
    found = min(k + 1, len(points))
    tree = _tree_of(points, found)
    same = torch.empty_like(own, dtype=torch.bool)

    def search(these: slice) -> None:
        _, indices = tree.nearest(points[these], found)
        # The point itself comes first, or, among coincident points, anywhere or not at all: then
        # the first is replaced.
        indices = indices.where(indices != own[these, None], indices[:, :1])
        near[these, : found - 1] = indices[:, 1:].to(torch.int32)
        same[these] = (points[near[these, k - 1].long()] == points[these]).all(1)

    parallel_for(search, pieces(len(points), points.device, QUERIES_AT_ONCE), points.device)
    crowd = same.nonzero()[:, 0]
    if found > k and len(crowd):
        walk = tree.order
        before = torch.empty_like(walk)
        after = torch.empty_like(walk)
        before[walk] = walk.roll(1)
        after[walk] = walk.roll(-1)
        near[crowd, k - 2] = before[crowd].to(torch.int32)
        near[crowd, k - 1] = after[crowd].to(torch.int32)
    return near


class NearestOf:
    """Nearest points of arbitrary positions.

    Args:
        points: (N, 3) float64, finite, on any device; N is at least 1.
        k: number of neighbours.
    """

    def __init__(self, points: Tensor, k: int):
        self._k = min(k, len(points))
        self._tree = _tree_of(points, self._k)

    def __call__(self, queries: Tensor) -> Tensor:
        """Indices (m, min(k, N)) int64 of the points nearest to queries (m, 3) float64, finite, on
        their device; nearest first."""
        return self._tree.nearest(queries, self._k)[1]
