"""Where the Gaussians of a scene are: its unit cube, and the grids and curves by which the network
finds neighbours.

All of it follows from positions alone. Points are stored along the first curve of the
configuration, so that the points of a cell are consecutive at every level, and neighbours are close
in memory.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import interleave, spread_bits
from pointsplat_ns.refinement.config import RefinerConfig
from pointsplat_ns.refinement.local_units import LocalUnits, local_units
from pointsplat_ns.refinement.sparse_ops import KernelMap, Order
from pointsplat_ns.scene.gaussians import Gaussians

FINE_BITS = 16
"""Bits per axis of the finest position code. Every grid of the network is coarser."""


@dataclass(frozen=True)
class UnitCube:
    """A cube in scene units; all fields in float64."""

    centre: Tensor  # [3] scene units
    extent: Tensor  # [] side of the cube, scene units, above 0

    def positions(self, means: Tensor) -> Tensor:
        """Positions in [-0.5, 0.5], float64; those outside the cube are clamped to it. # [N, 3]"""
        return ((means.double() - self.centre) / self.extent).clamp(-0.5, 0.5)


def unit_cube(means: Tensor) -> UnitCube:
    """The unit cube of at least one finite position (N, 3), scene units.

    The core of the scene is the box of its positions without the outermost 1 % at each end of each
    axis (at least one position, from 8 positions on). The box of all positions is cut to the core
    plus half of the core's longest side in each direction. A scene without outliers keeps its full
    extent; an outlier at most doubles it. The cube has the centre and the longest side of the cut
    box, or side 1 where that is zero.
    """
    axes = means.detach().T.contiguous()  # [3, N]
    n = axes.shape[1]
    trim = max(1, math.ceil(0.01 * n)) if n >= 8 else 0
    low, high = (value.double() for value in axes.aminmax(dim=1))
    core_low, core_high = (axes.kthvalue(k, dim=1).values.double() for k in (trim + 1, n - trim))
    reach = 0.5 * (core_high - core_low).max()
    if reach > 0:
        low = torch.maximum(low, core_low - reach)
        high = torch.minimum(high, core_high + reach)
    extent = (high - low).max()
    return UnitCube(
        low + (high - low) / 2, torch.where(extent > 0, extent, torch.ones_like(extent))
    )


def curve_codes(coords: Tensor, bits: int, curves: Sequence[str]) -> list[Tensor]:
    """Codes (N,) in ``[0, 8**bits)`` along each named space-filling curve, int64.

    Points that are close along a curve are close in space, so a patch of consecutive points is a
    neighbourhood. The code of a coarser cell is the code of any of its points without the last
    three bits per halving, so one sort serves all grids of the network.

    Args:
        coords: integer coordinates, each at least 0 and below ``2**bits``.  # [N, 3] int64
        bits: bits per axis, at most 20.
        curves: ``z`` for the z-order (Morton) curve, which interleaves the bits of the three axes;
            ``hilbert`` for the Hilbert curve, whose consecutive cells always share a face; or
            either with ``-trans``: the same curve with x and y exchanged.
    """
    codes = []
    for curve in curves:
        x, y, z = coords.unbind(1)
        axes = (y, x, z) if curve.endswith("-trans") else (x, y, z)
        codes.append(
            interleave(
                *map(spread_bits, _gray_axes(axes, bits) if curve.startswith("hilbert") else axes)
            )
        )
    return codes


def _gray_axes(coords: tuple[Tensor, Tensor, Tensor], bits: int) -> tuple[Tensor, Tensor, Tensor]:
    """Three numbers (N,) each, whose interleaved bits are the Hilbert codes of coordinates (N,)
    each.

    At each bit, a mirror or an exchange of axes applies to all lower bits. Then the bits are
    Gray-coded. Source: J. Skilling, "Programming the Hilbert curve", AIP Conference Proceedings 707
    (2004).
    """
    axes = list(coords)
    for bit in range(bits - 1, 0, -1):
        low = (1 << bit) - 1
        for i in range(3):
            mirrored = -(axes[i] >> bit & 1)  # all bits set, or none
            exchanged = (axes[0] ^ axes[i]) & low & ~mirrored
            axes[i] = axes[i] ^ exchanged
            axes[0] = axes[0] ^ (exchanged | (mirrored & low))
    x = axes[0]
    y = axes[1] ^ x
    z = axes[2] ^ y
    parity = torch.zeros_like(z)
    for bit in range(bits - 1, 0, -1):
        parity ^= -(z >> bit & 1) & ((1 << bit) - 1)
    return x ^ parity, y ^ parity, z ^ parity


HALF_KERNEL = [
    (dx, dy, dz)
    for dx in (0, 1)
    for dy in (-1, 0, 1)
    for dz in (-1, 0, 1)
    if (dx, dy, dz) > (0, 0, 0)
]
"""The 13 offsets of a 3x3x3 kernel that come after the centre; the other 13 are their negatives."""


@dataclass(frozen=True)
class GridLevel:
    """One resolution: its M points (cells, at all levels but the first) in memory order."""

    size: int
    cell_of: Tensor | None  # [M] cell of each point; None where each point has its own
    num_cells: int
    neighbours: KernelMap  # per offset of HALF_KERNEL: cells (i, j) with j at i + offset
    orders: list[Order | None]  # per curve; None: memory order
    cluster: Tensor | None  # [M] cell of the next level, non-decreasing; None at the last level


@dataclass(frozen=True)
class Structure:
    """Cube, memory order and levels of one scene, for one configuration."""

    cube: UnitCube
    order: Tensor  # [N] scene index of the point at each place in memory
    inverse: Tensor  # [N] place in memory of each Gaussian of the scene
    levels: list[GridLevel]
    built_for: tuple  # the settings that it depends on, :func:`structure_key` of its configuration
    usable: Tensor | None = None  # [T] mask of the N Gaussians in the structure; None: all
    local: LocalUnits | None = None  # neighbours in memory order, for networks with local units

    @property
    def total(self) -> int:
        """Number of Gaussians of the scene, with undrawable ones."""
        return len(self.order if self.usable is None else self.usable)


def structure_key(config: RefinerConfig) -> tuple:
    """The settings that a structure depends on."""
    return (config.grid, tuple(config.strides), tuple(config.curves), config.units)


@torch.no_grad()
def build_structure(scene: Gaussians, config: RefinerConfig) -> Structure:
    """Levels of a scene of at least one usable Gaussian, by ``grid``, ``strides`` and ``curves`` of
    the configuration.

    Points with equal finest codes (1 / 2^16 of the cube) are ordered by all their parameters, so
    that the result does not depend on the order of the Gaussians.
    """
    cube = unit_cube(scene.means)
    # per axis, by which the finest code splits a cell of a fixed grid: a grid of 512 needs 16 in
    # all
    fixed_bits = 7
    units = 2**FINE_BITS if config.grid is None else config.grid << fixed_bits
    fine = ((cube.positions(scene.means) + 0.5) * units).long().clamp_(0, units - 1)
    codes = curve_codes(fine, FINE_BITS, config.curves)
    order, depths = _canonical_order(scene, codes[0])
    shift = _adaptive_shift(depths) if config.grid is None else fixed_bits

    levels = []
    halvings = [0, *itertools.accumulate(stride.bit_length() - 1 for stride in config.strides)]
    shifts = [min(shift + count, FINE_BITS) for count in halvings]
    first = order  # in the scene, a representative point of each point of the level
    along = [code.index_select(0, order).argsort(stable=True) for code in codes[1:]]
    orders = [(one, _invert(one)) for one in along]
    for i, s in enumerate(shifts):
        cell_of, cell_first = _runs(depths, s)
        cells = fine.index_select(0, first.index_select(0, cell_first)) >> s
        cluster, next_first = _runs(depths, shifts[i + 1]) if i + 1 < len(shifts) else (None, None)
        levels.append(
            GridLevel(
                size=len(first),
                cell_of=None if len(cells) == len(first) else cell_of,
                num_cells=len(cells),
                neighbours=neighbour_pairs(cells),
                orders=[None, *orders],
                cluster=cluster,
            )
        )
        if cluster is not None and next_first is not None:
            first = first.index_select(0, next_first)
            depths = depths.index_select(0, next_first)
            orders = [_coarser_order(one, cluster) for one, _ in orders]
    # in memory order, which does not depend on the order of the scene
    local = local_units(scene[order]) if config.units == "local" else None
    return Structure(
        cube=cube,
        order=order,
        inverse=_invert(order),
        levels=levels,
        built_for=structure_key(config),
        local=local,
    )


def neighbour_pairs(cells: Tensor) -> KernelMap:
    """Existing neighbours of distinct cells in the 3x3x3 kernel, of integer coordinates (M, 3) from
    0 to 2^20, at least one.

    Returns:
        per offset of :data:`HALF_KERNEL`, the indices ``i`` and ``j`` of all pairs with
        ``cells[j] == cells[i] + offset``, ``i`` increasing.  # [P], [P] int64
    """
    # two empty cells after the last of each axis: no offset wraps around
    m = len(cells)
    side = int(cells.max()) + 3
    keys = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    keys, index = keys.to(
        torch.int32 if side**3 < 2**31 else torch.int64
    ).sort()  # half the width takes half the time
    following = (keys[1:] == keys[:-1] + 1).nonzero()[:, 0]  # offset (0, 0, 1)
    found = [index.index_select(0, following)]  # index of the offset times M, plus i
    partners = [index.index_select(0, following + 1)]
    # The three cells of another column (dx, dy) are consecutive in the sorted keys, so one search
    # finds them all. Its targets are sorted too, which halves its time.
    columns = [
        (i, (dx * side + dy) * side - 1) for i, (dx, dy, dz) in enumerate(HALF_KERNEL) if dz == -1
    ]
    numbers, steps = torch.tensor(columns, device=keys.device, dtype=torch.int64)[
        :, :, None
    ].unbind(1)
    numbered = (index + numbers * m).flatten()
    target = (keys + steps.to(keys.dtype)).flatten()
    place = torch.searchsorted(keys, target)
    keys = torch.cat([keys, keys.new_full((1,), torch.iinfo(keys.dtype).max)])
    for dz in range(3):
        hit = keys.index_select(0, place) == target
        at = hit.nonzero()[:, 0]
        found.append(numbered.index_select(0, at).add_(dz * m))
        partners.append(index.index_select(0, place.index_select(0, at)))
        place = place.add_(hit)
        target = target.add_(1)
    numbered, order = torch.cat(found).sort()
    j = torch.cat(partners).index_select(0, order)
    counts = torch.bincount(numbered // m, minlength=len(HALF_KERNEL)).tolist()
    return list(zip((numbered % m).split(counts), j.split(counts), strict=True))


def _canonical_order(scene: Gaussians, codes: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of the scene sorted by code, with ties sorted by the parameters; and for each code
    the position, from 1, of the highest bit that differs from the previous code. With ``s`` bits
    dropped per axis, a new cell begins where this position exceeds ``3 * s``. # [N], [N]"""
    codes, order = codes.sort(stable=True)
    depths = torch.frexp((codes[1:] ^ codes[:-1]).double()).exponent
    depths = torch.cat([depths.new_full((1,), 64), depths])
    if (depths == 0).any():
        same = depths[1:] == 0
        tied = torch.zeros(len(codes), dtype=torch.bool, device=codes.device)
        tied[1:] |= same
        tied[:-1] |= same
        place = tied.nonzero()[:, 0]
        rows = torch.cat([value.flatten(1) for value in scene[order[place]].tensors()], dim=1)
        rank = torch.unique(rows, dim=0, return_inverse=True)[1]
        by_rank = rank.argsort(stable=True)
        by_code = codes[place][by_rank].argsort(stable=True)
        order[place] = order[place[by_rank[by_code]]]
    return order, depths


def _adaptive_shift(depths: Tensor) -> int:
    """Bits per axis to drop from the finest codes, as many as possible with one or two positions in
    a cell, so that neighbours are in adjacent cells."""
    cells = (
        torch.bincount(depths, minlength=65).flip(0).cumsum(0).flip(0).tolist()
    )  # of at least that many bits
    for shift in range(FINE_BITS, 0, -1):
        if cells[3 * shift + 1] >= 0.6 * cells[1]:  # occupied cells per distinct position
            return shift
    return 0


def _runs(depths: Tensor, shift: int) -> tuple[Tensor, Tensor]:
    """Cell of each place [M] and first place of each cell [R], with ``shift`` bits per axis
    dropped."""
    starts = depths > 3 * shift
    return starts.cumsum(0) - 1, starts.nonzero()[:, 0]


def _coarser_order(along: Tensor, cluster: Tensor) -> Order:
    """The order of the next level. A curve visits all points of a cell in a row, so it visits the
    cells in the order of their first points."""
    cells = cluster.index_select(0, along)
    starts = torch.ones_like(cells, dtype=torch.bool)
    torch.ne(cells[1:], cells[:-1], out=starts[1:])
    order = cells.masked_select(starts)
    return order, _invert(order)


def _invert(order: Tensor) -> Tensor:
    return torch.empty_like(order).scatter_(
        0, order, torch.arange(len(order), device=order.device, dtype=torch.int64)
    )
