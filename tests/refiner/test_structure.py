import itertools

import pytest
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner import structure as structure_module
from pointsplat_ns.refiner.config import FINE_BITS, preset
from pointsplat_ns.refiner.structure import STRUCTURE, StructureSettings, build_structure, neighbour_pairs


def scene_at(means: torch.Tensor, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    n = len(means)
    shapes = ((n, 3), (n, 4), (n, 1), (n, 3), (n, 3, 3))
    return Gaussians(means, *(torch.randn(shape, generator=g) for shape in shapes))


def surface(n: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=g)
    means[torch.arange(n), torch.randint(0, 3, (n,), generator=g)] = 0.0
    return means


@pytest.mark.parametrize("size", ["full", "small", "tiny"])
def test_orders_are_permutations_and_clusters_are_runs_without_gaps(size):
    structure = build_structure(scene_at(surface(500)), preset(size))
    assert structure.order.sort().values.tolist() == list(range(500))
    assert torch.equal(structure.order[structure.inverse], torch.arange(500))
    for level, coarser in itertools.zip_longest(structure.levels, structure.levels[1:]):
        for order, inverse in level.orders[1:]:
            assert torch.equal(order[inverse], torch.arange(level.size))
        if coarser is None:
            assert level.cluster is None
        else:
            steps = level.cluster[1:] - level.cluster[:-1]
            assert level.cluster[0] == 0 and level.cluster[-1] == coarser.size - 1
            assert ((steps == 0) | (steps == 1)).all()
            assert level.cell_of is None or coarser.size <= level.num_cells


def test_clusters_hold_exactly_the_points_of_a_cell():
    means = surface(800)
    config = preset("full", grid=64)
    structure = build_structure(scene_at(means), config)
    position = structure.cube.positions(means)[structure.order] + 0.5
    cluster = torch.arange(800)
    for level, stride in zip(structure.levels, (1, 2, 4, 8), strict=False):
        cluster = level.cluster[cluster]
        cells = (position * 64 / stride).floor().clamp(max=64 // stride - 1).long()
        expected = torch.unique(cells, dim=0, return_inverse=True)[1]
        joint = torch.unique(torch.stack([cluster, expected], dim=1), dim=0)
        assert len(joint) == len(cluster.unique()) == len(expected.unique())


@pytest.mark.parametrize("n", [50, 500, 5000])
def test_an_adapted_grid_is_the_coarsest_that_keeps_most_points_apart(n):
    means = surface(n)
    structure = build_structure(scene_at(means), preset("tiny"))
    position = structure.cube.positions(means) + 0.5

    def occupied(side):
        return len(torch.unique((position * side).floor().clamp(max=side - 1), dim=0))

    sides = [2**bits for bits in range(FINE_BITS + 1)]
    coarsest = next(side for side in sides if occupied(side) >= STRUCTURE.occupancy * n)
    assert structure.levels[0].num_cells == occupied(coarsest) > occupied(coarsest // 2)


def test_strides_beyond_the_finest_code_end_in_one_cell():
    config = preset("tiny", strides=(2**10, 2**10), grid=512)
    structure = build_structure(scene_at(surface(100)), config)
    assert structure.levels[-1].size == 1
    assert 2**10 * 2**10 > 2**FINE_BITS


@pytest.mark.parametrize("spread", [1, 3, 100, 2**16 - 1])
def test_looking_up_and_searching_find_the_pairs_that_brute_force_finds_in_order(spread, monkeypatch):
    g = torch.Generator().manual_seed(4)
    cells = torch.cat([torch.randint(0, 8, (120, 3), generator=g), torch.tensor([[0, 0, 0], [spread] * 3])])
    cells = torch.unique(torch.cat([cells, spread - cells.clamp(max=spread)]), dim=0).clamp(0, spread)
    cells = torch.unique(cells, dim=0)
    cells = cells[torch.randperm(len(cells), generator=g)]
    expected = []
    for offset in structure_module.HALF_KERNEL:
        match = (cells[:, None] + torch.tensor(offset) == cells[None]).all(dim=-1)
        expected.append(match.nonzero().T.tolist())
    ways = [0, 2**60] if spread <= 100 else [0]  # a table of 2^48 entries fits nowhere
    for entries in ways:
        settings = StructureSettings(table_per_cell=entries, table_limit=2**31)
        monkeypatch.setattr(structure_module, "STRUCTURE", settings)
        assert [[i.tolist(), j.tolist()] for i, j in neighbour_pairs(cells)] == expected
