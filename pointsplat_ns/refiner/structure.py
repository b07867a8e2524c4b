"""Everything that the network derives from positions alone: built once per scene, used at every step.

Points are laid out in memory along the first curve of the configuration, so that the points of a
cell are consecutive at every level and a gather of neighbours stays near in memory.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.config import FINE_BITS, RefinerConfig
from pointsplat_ns.refiner.normalize import UnitCube, unit_cube
from pointsplat_ns.refiner.serialization import curve_codes

FIXED_GRID_BITS = 7
"""With a fixed grid, each cell is split into 2^7 per axis for the finest code: 512 cells fill 16 bits."""

ADAPTIVE_OCCUPANCY = 0.6
"""An adapted grid is the coarsest whose occupied cells number at least this share of the distinct positions:
one or two points a cell, with neighbours in the adjoining ones."""

HALF_KERNEL = [
    (dx, dy, dz)
    for dx in (0, 1)
    for dy in (-1, 0, 1)
    for dz in (-1, 0, 1)
    if (dx, dy, dz) > (0, 0, 0)
]  # fmt: skip
"""The 13 offsets of a 3x3x3 kernel that come after the centre; the other 13 are their negatives."""


@dataclass(frozen=True)
class Level:
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
    levels: list[Level]
    cells_per_side: float  # of the first level, along the unit cube
    built_for: tuple  # the settings that it depends on
    usable: Tensor | None = None  # [T] mask of the scene's Gaussians that it covers, N of them; None: it covers all

    @property
    def total(self) -> int:
        """Gaussians of the scene, those that cannot be drawn included."""
        return len(self.order if self.usable is None else self.usable)

    def to(self, device: torch.device | str) -> Structure:
        """The same structure on another device."""

        def move(value):
            if isinstance(value, (Tensor, UnitCube)):
                return value.to(device)
            if isinstance(value, Level):
                return Level(**{f.name: move(getattr(value, f.name)) for f in dataclasses.fields(value)})
            if isinstance(value, (list, tuple)):
                return type(value)(move(item) for item in value)
            return value

        return Structure(**{f.name: move(getattr(self, f.name)) for f in dataclasses.fields(self)})


def structure_key(config: RefinerConfig) -> tuple:
    """The settings that a structure depends on."""
    return (config.grid, tuple(config.strides), tuple(config.curves))


@torch.no_grad()
def build_structure(scene: Gaussians, config: RefinerConfig) -> Structure:
    """Levels of a scene.

    Points that share even the finest code (a 2^-16 of the cube) are ordered by all their
    parameters, so that the result depends on the set of Gaussians and not on their order.

    Args:
        scene: at least one usable Gaussian.
        config: ``grid``, ``strides`` and ``curves`` are used.
    """
    cube = unit_cube(scene.means)
    units = 2**FINE_BITS if config.grid is None else config.grid << FIXED_GRID_BITS
    fine = ((cube.positions(scene.means) + 0.5) * units).floor().long().clamp(0, units - 1)
    order = _canonical_order(scene, curve_codes(fine, FINE_BITS, config.curves[0]))
    fine = fine[order]
    codes = [curve_codes(fine, FINE_BITS, curve) for curve in config.curves]
    shift = FIXED_GRID_BITS if config.grid is not None else _adaptive_shift(codes[0])
    cells_per_side = units / 2**shift

    levels = []
    shifts = [min(shift + _log2_product(config.strides[:i]), FINE_BITS) for i in range(len(config.strides) + 1)]
    first = torch.arange(len(scene), device=scene.device)  # a representative point of each point of the level
    for i, s in enumerate(shifts):
        is_last = i + 1 == len(shifts)
        cell_of, cell_first = _runs(codes[0][first], s)
        cells = fine[first[cell_first]] >> s
        orders = [_argsort_pair(code[first] >> (0 if i == 0 else 3 * s)) for code in codes]
        cluster, next_first = (None, None) if is_last else _runs(codes[0][first], shifts[i + 1])
        levels.append(
            Level(
                size=len(first),
                cell_of=None if len(cells) == len(first) else cell_of,
                num_cells=len(cells),
                neighbours=neighbour_pairs(cells),
                orders=[None, *orders[1:]],
                cluster=cluster,
            )
        )
        if not is_last:
            first = first[next_first]
    return Structure(cube, order, _invert(order), levels, cells_per_side, structure_key(config))


def neighbour_pairs(cells: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Existing neighbours of distinct cells in the 3x3x3 kernel.

    Args:
        cells: distinct integer coordinates from 0 to 2^19.  # [M, 3] int64

    Returns:
        per offset of :data:`HALF_KERNEL`, the indices ``i`` and ``j`` of all pairs with
        ``cells[j] == cells[i] + offset``.  # [P], [P] int64
    """
    bits = 20
    keys = ((cells[:, 0] + 1) << 2 * bits) | ((cells[:, 1] + 1) << bits) | (cells[:, 2] + 1)
    keys, index = keys.sort()
    end = len(keys) - 1
    matches = torch.empty_like(index)
    pairs, column = [], None
    for dx, dy, dz in HALF_KERNEL:
        target = keys + ((dx << 2 * bits) + (dy << bits) + dz)
        if (dx, dy) != column:  # the three cells of a column follow one another in the sorted keys
            column = (dx, dy)
            place = torch.searchsorted(keys, target).clamp_(max=end)
        else:
            place = (place + (keys.index_select(0, place) < target)).clamp_(max=end)
        found = keys.index_select(0, place) == target
        # Scattered into memory order, the pairs come out sorted by it.
        matches.scatter_(0, index, torch.where(found, index.index_select(0, place), -1))
        i = (matches >= 0).nonzero()[:, 0]
        pairs.append((i, matches.index_select(0, i)))
    return pairs


def _canonical_order(scene: Gaussians, codes: Tensor) -> Tensor:
    """Indices of the scene sorted by code, ties by the parameters."""
    codes, order = codes.sort(stable=True)
    same = codes[1:] == codes[:-1]
    tied = torch.zeros(len(codes), dtype=torch.bool, device=codes.device)
    tied[1:] |= same
    tied[:-1] |= same
    place = tied.nonzero()[:, 0]
    if len(place):
        rows = torch.cat([value.flatten(1) for value in scene[order[place]].tensors()], dim=1)
        rank = torch.unique(rows, dim=0, return_inverse=True)[1]
        by_rank = rank.argsort(stable=True)
        by_code = codes[place][by_rank].argsort(stable=True)
        order[place] = order[place[by_rank[by_code]]]
    return order


def _adaptive_shift(codes: Tensor) -> int:
    """Bits to drop per axis from sorted finest codes, so that about one or two positions share a cell."""
    distinct = codes.unique_consecutive()
    for shift in range(FINE_BITS, 0, -1):
        if (distinct >> 3 * shift).unique_consecutive().numel() >= ADAPTIVE_OCCUPANCY * distinct.numel():
            return shift
    return 0


def _runs(codes: Tensor, shift: int) -> tuple[Tensor, Tensor]:
    """Runs of equal cells in sorted codes: run of each place [M], first place of each run [R]."""
    cells = codes >> 3 * shift
    starts = torch.ones_like(cells, dtype=torch.bool)
    starts[1:] = cells[1:] != cells[:-1]
    return starts.cumsum(0) - 1, starts.nonzero()[:, 0]


def _argsort_pair(codes: Tensor) -> tuple[Tensor, Tensor]:
    order = codes.argsort(stable=True)
    return order, _invert(order)


def _invert(order: Tensor) -> Tensor:
    return torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))


def _log2_product(strides: tuple[int, ...]) -> int:
    return sum(s.bit_length() - 1 for s in strides)
