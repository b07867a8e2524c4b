"""Neighbour tables and curve orders of a scene, from positions alone: built once, used at every step.

Points are stored along the first curve of the configuration, so that the points of a cell are consecutive at every
level, and neighbours are close in memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.config import FINE_BITS, RefinerConfig
from pointsplat_ns.refiner.normalize import UnitCube, unit_cube
from pointsplat_ns.refiner.serialization import curve_codes


@dataclass(frozen=True)
class StructureSettings:
    """Settings of grids and neighbour tables."""

    fixed_grid_bits: int = 7
    """Bits per axis by which the finest code splits the cells of a fixed grid: a grid of 512 needs 16 bits in all."""
    occupancy: float = 0.6
    """Least number of occupied cells per distinct position in an adapted grid, which is the coarsest such grid: one or
    two points share a cell, and neighbours are in adjacent cells."""
    table_per_cell: int = 128
    """Largest number of entries (4 bytes each) per occupied cell in a table of the whole grid, which finds neighbours.
    Larger grids are searched, which is three to eight times slower."""
    table_limit: int = 2**26
    """Largest number of entries of that table: 256 MB."""


STRUCTURE = StructureSettings()

HALF_KERNEL = [
    (dx, dy, dz)
    for dx in (0, 1)
    for dy in (-1, 0, 1)
    for dz in (-1, 0, 1)
    if (dx, dy, dz) > (0, 0, 0)
]  # fmt: skip
"""The 13 offsets of a 3x3x3 kernel that come after the centre; the other 13 are their negatives."""


@dataclass(frozen=True)
class GridLevel:
    """One resolution: its M points (cells, at all levels but the first) in memory order."""

    size: int
    cell_of: Tensor | None  # [M] cell of each point; None where each point has its own
    num_cells: int
    neighbours: list[tuple[Tensor, Tensor]]  # per offset of HALF_KERNEL: cells (i, j) with j at i + offset
    orders: list[tuple[Tensor, Tensor] | None]  # per curve: order and its inverse, [M] each; None: memory order
    cluster: Tensor | None  # [M] cell of the next level, non-decreasing; None at the last level


@dataclass(frozen=True)
class Structure:
    """Cube, memory order and levels of one scene, for one configuration."""

    cube: UnitCube
    order: Tensor  # [N] scene index of the point at each place in memory
    inverse: Tensor  # [N] place in memory of each Gaussian of the scene
    levels: list[GridLevel]
    built_for: tuple  # :func:`structure_key` of its configuration
    usable: Tensor | None = None  # [T] mask of the N Gaussians in the structure; None: all

    @property
    def total(self) -> int:
        """Number of Gaussians of the scene, with undrawable ones."""
        return len(self.order if self.usable is None else self.usable)


def structure_key(config: RefinerConfig) -> tuple:
    """The settings that a structure depends on."""
    return (config.grid, tuple(config.strides), tuple(config.curves))


@torch.no_grad()
def build_structure(scene: Gaussians, config: RefinerConfig) -> Structure:
    """Levels of a scene of at least one usable Gaussian, by ``grid``, ``strides`` and ``curves`` of the configuration.

    Points with equal finest codes (1 / 2^16 of the cube) are ordered by all their parameters, so that the result does
    not depend on the order of the Gaussians.
    """
    cube = unit_cube(scene.means)
    units = 2**FINE_BITS if config.grid is None else config.grid << STRUCTURE.fixed_grid_bits
    fine = ((cube.positions(scene.means) + 0.5) * units).long().clamp_(0, units - 1)
    codes = curve_codes(fine, FINE_BITS, config.curves)
    order, depths = _canonical_order(scene, codes[0])
    shift = STRUCTURE.fixed_grid_bits if config.grid is not None else _adaptive_shift(depths)

    levels = []
    shifts = [min(shift + _log2_product(config.strides[:i]), FINE_BITS) for i in range(len(config.strides) + 1)]
    first = order  # in the scene, a representative point of each point of the level
    orders = [_argsort_pair(code.index_select(0, order)) for code in codes[1:]]
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
            first, depths = first.index_select(0, next_first), depths.index_select(0, next_first)
            orders = [_coarser_pair(along, cluster, len(first)) for along, _ in orders]
    return Structure(cube, order, _invert(order), levels, structure_key(config))


def neighbour_pairs(cells: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Existing neighbours of distinct cells in the 3x3x3 kernel, of integer coordinates (M, 3) from 0 to 2^20, at least
    one.

    Returns:
        per offset of :data:`HALF_KERNEL`, the indices ``i`` and ``j`` of all pairs with
        ``cells[j] == cells[i] + offset``, ``i`` increasing.  # [P], [P] int64
    """
    m = len(cells)
    side = int(cells.max()) + 3  # two empty cells after the last along each axis, so that no offset wraps around
    keys = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    if side**3 <= min(STRUCTURE.table_per_cell * m, STRUCTURE.table_limit):
        numbered, j = _look_up(keys, side)
    else:
        numbered, j = _search(keys, side)
    counts = torch.bincount(numbered // m, minlength=len(HALF_KERNEL)).tolist()
    return list(zip((numbered % m).split(counts), j.split(counts), strict=True))


def _look_up(keys: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Pairs from a table of the whole grid: index of the offset times M plus i, increasing, and j. # [P], [P]"""
    table = torch.zeros(side**3, dtype=torch.int32, device=keys.device)
    table[keys] = torch.arange(1, len(keys) + 1, dtype=torch.int32, device=keys.device)
    steps = [[(dx * side + dy) * side + dz] for dx, dy, dz in HALF_KERNEL]
    target = keys.to(torch.int32) + torch.tensor(steps, dtype=torch.int32, device=keys.device)
    partner = table.index_select(0, target.flatten())
    numbered = partner.nonzero()[:, 0]
    return numbered, partner.index_select(0, numbered).long() - 1


def _search(keys: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """The same pairs by search among the sorted keys, for grids of any size. # [P], [P]"""
    m = len(keys)
    keys, index = keys.to(torch.int32 if side**3 < 2**31 else torch.int64).sort()  # half the width takes half the time
    following = (keys[1:] == keys[:-1] + 1).nonzero()[:, 0]  # offset (0, 0, 1)
    found = [index.index_select(0, following)]
    partners = [index.index_select(0, following + 1)]
    # The three cells of another column (dx, dy) are consecutive in the sorted keys, so one search finds them all. Its
    # targets are sorted too, which halves its time.
    columns = [(i, (dx * side + dy) * side - 1) for i, (dx, dy, dz) in enumerate(HALF_KERNEL) if dz == -1]
    numbers, steps = torch.tensor(columns, device=keys.device, dtype=torch.int64)[:, :, None].unbind(1)
    numbered, target = (index + numbers * m).flatten(), (keys + steps.to(keys.dtype)).flatten()
    place = torch.searchsorted(keys, target)
    keys = torch.cat([keys, keys.new_full((1,), torch.iinfo(keys.dtype).max)])
    for dz in range(3):
        hit = keys.index_select(0, place) == target
        at = hit.nonzero()[:, 0]
        found.append(numbered.index_select(0, at).add_(dz * m))
        partners.append(index.index_select(0, place.index_select(0, at)))
        place, target = place.add_(hit), target.add_(1)
    in_memory, order = torch.cat(found).sort()
    return in_memory, torch.cat(partners).index_select(0, order)


def _canonical_order(scene: Gaussians, codes: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of the scene sorted by code, with ties sorted by the parameters; and for each code the position, from 1,
    of the highest bit that differs from the previous code. With ``s`` bits dropped per axis, a new cell begins where
    this position exceeds ``3 * s``. # [N], [N]"""
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
    """Bits per axis to drop from the finest codes, so that one or two positions share a cell."""
    cells = torch.bincount(depths, minlength=65).flip(0).cumsum(0).flip(0).tolist()  # of at least that many bits
    for shift in range(FINE_BITS, 0, -1):
        if cells[3 * shift + 1] >= STRUCTURE.occupancy * cells[1]:
            return shift
    return 0


def _runs(depths: Tensor, shift: int) -> tuple[Tensor, Tensor]:
    """Cell of each place [M] and first place of each cell [R], with ``shift`` bits per axis dropped."""
    starts = depths > 3 * shift
    return starts.cumsum(0) - 1, starts.nonzero()[:, 0]


def _coarser_pair(along: Tensor, cluster: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Order of the next level and its inverse. A curve visits all points of a cell in a row, so it visits the cells in
    the order of their first points."""
    cells = cluster.index_select(0, along)
    starts = torch.ones_like(cells, dtype=torch.bool)
    torch.ne(cells[1:], cells[:-1], out=starts[1:])
    order = cells.masked_select(starts)
    return order, _invert(order)


def _argsort_pair(codes: Tensor) -> tuple[Tensor, Tensor]:
    order = codes.argsort(stable=True)
    return order, _invert(order)


def _invert(order: Tensor) -> Tensor:
    return torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device, dtype=torch.int64))


def _log2_product(strides: tuple[int, ...]) -> int:
    return sum(s.bit_length() - 1 for s in strides)
