"""Where the Gaussians of a scene are: unit cube, curves, grids and neighbours."""

import pytest
import torch

from making import normal_scene
from pointsplat_ns.refinement import refiner_preset
from pointsplat_ns.refinement.structure import (
    FINE_BITS,
    HALF_KERNEL,
    build_structure,
    curve_codes,
    neighbour_pairs,
    unit_cube,
)
from pointsplat_ns.scene.gaussians import Gaussians


def test_one_far_outlier_at_most_doubles_the_extent():
    means = torch.rand(1000, 3)
    plain = unit_cube(means).extent
    means[0] = 1e6
    cube = unit_cube(means)
    assert cube.extent <= 2.0 * plain
    position = cube.positions(means)
    assert position.abs().max() <= 0.5
    assert (position[1:].amax(0) - position[1:].amin(0)).min() > 0.3


@pytest.mark.parametrize(
    "means",
    [
        torch.zeros(1, 3),
        torch.ones(5, 3) * 1e6,
        torch.tensor([[0.0, 0, 0], [1e-30, 0, 0]]),
        torch.tensor([[-3e38, 0, 0], [3e38, 0, 0]]),
        torch.tensor([[0.0, 0, 0]] * 20 + [[7.0, 0, 0]]),
    ],
    ids=["one", "coincident", "tiny", "huge", "one-apart"],
)
def test_degenerate_extents_give_finite_positions_within_the_cube(means):
    cube = unit_cube(means)
    assert cube.extent > 0 and cube.extent.isfinite()
    position = cube.positions(means)
    assert position.isfinite().all() and position.abs().max() <= 0.5


def interleaved(axes: list[int], bits: int) -> int:
    return sum(
        (axis >> b & 1) << (3 * b + 2 - i) for i, axis in enumerate(axes) for b in range(bits)
    )


def skilling(point: list[int], bits: int) -> int:
    """Hilbert code of one point, bit by bit, as published."""
    axes = list(point)
    for bit in range(bits - 1, 0, -1):
        low = (1 << bit) - 1
        for i in range(3):
            if axes[i] >> bit & 1:
                axes[0] ^= low
            else:
                swapped = (axes[0] ^ axes[i]) & low
                axes[0] ^= swapped
                axes[i] ^= swapped
    axes[1] ^= axes[0]
    axes[2] ^= axes[1]
    parity = 0
    for bit in range(bits - 1, 0, -1):
        if axes[2] >> bit & 1:
            parity ^= (1 << bit) - 1
    return interleaved([axis ^ parity for axis in axes], bits)


@pytest.mark.parametrize("bits", [1, 2, 5, 16, 19, 20])
def test_hilbert_codes_are_those_of_the_published_algorithm(bits):
    coords = torch.randint(0, 2**bits, (200, 3), generator=torch.Generator().manual_seed(2))
    z, hilbert, other = curve_codes(coords, bits, ["z", "hilbert", "hilbert-trans"])
    assert hilbert.tolist() == [skilling(point, bits) for point in coords.tolist()]
    assert other.tolist() == [skilling([y, x, z], bits) for x, y, z in coords.tolist()]
    assert z.tolist() == [interleaved(point, bits) for point in coords.tolist()]


def surface(n: int) -> Gaussians:
    """Gaussians on three sides of a cube."""
    g = torch.Generator().manual_seed(0)
    means = torch.rand(n, 3, generator=g)
    means[torch.arange(n), torch.randint(0, 3, (n,), generator=g)] = 0.0
    return normal_scene(n).replace(means=means)


def test_clusters_hold_the_points_of_a_cell_and_orders_are_permutations():
    scene = surface(800)
    config = refiner_preset("full", grid=64)
    structure = build_structure(scene, config)
    position = structure.cube.positions(scene.means)[structure.order] + 0.5
    cluster = torch.arange(800)
    for level, stride in zip(structure.levels, (1, 2, 4, 8), strict=False):
        for order, inverse in level.orders[1:]:
            assert torch.equal(order[inverse], torch.arange(level.size))
        cluster = level.cluster[cluster]
        assert set(cluster.diff().tolist()) <= {0, 1}, "cells of a level are runs without gaps"
        cells = (position * 64 / stride).floor().clamp(max=64 // stride - 1).long()
        expected = torch.unique(cells, dim=0, return_inverse=True)[1]
        joint = torch.unique(torch.stack([cluster, expected], dim=1), dim=0)
        assert len(joint) == len(cluster.unique()) == len(expected.unique())


@pytest.mark.parametrize("n", [50, 500, 5000])
def test_an_adapted_grid_is_the_coarsest_that_keeps_most_points_apart(n):
    scene = surface(n)
    structure = build_structure(scene, refiner_preset("tiny"))
    position = structure.cube.positions(scene.means) + 0.5

    def occupied(side):
        return len(torch.unique((position * side).floor().clamp(max=side - 1), dim=0))

    sides = [2**bits for bits in range(FINE_BITS + 1)]
    coarsest = next(side for side in sides if occupied(side) >= 0.6 * n)
    assert structure.levels[0].num_cells == occupied(coarsest) > occupied(coarsest // 2)


@pytest.mark.parametrize("spread", [1, 100, 2**16 - 1])
def test_neighbour_pairs_are_those_of_brute_force_in_order(spread):
    g = torch.Generator().manual_seed(4)
    cells = torch.cat(
        [torch.randint(0, 8, (120, 3), generator=g), torch.tensor([[0, 0, 0], [spread] * 3])]
    )
    cells = torch.unique(torch.cat([cells, spread - cells.clamp(max=spread)]), dim=0).clamp(
        0, spread
    )
    cells = torch.unique(cells, dim=0)
    cells = cells[torch.randperm(len(cells), generator=g)]
    expected = []
    for offset in HALF_KERNEL:
        match = (cells[:, None] + torch.tensor(offset) == cells[None]).all(dim=-1)
        expected.append(match.nonzero().T.tolist())
    assert [[i.tolist(), j.tolist()] for i, j in neighbour_pairs(cells)] == expected
