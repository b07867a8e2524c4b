"""The structure of a scene, and the parts of the network."""

import itertools

import pytest
import torch
import torch.nn.functional as F

from making import move_zero_layers, normal_scene
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner import Refiner, preset, sparse_ops
from pointsplat_ns.refiner.network import DualBranchEncoder
from pointsplat_ns.refiner.refiner import gaussian_features
from pointsplat_ns.refiner.sparse_ops import permute, segment_max, segment_mean, submanifold_conv
from pointsplat_ns.refiner.structure import FINE_BITS, HALF_KERNEL, build_structure, neighbour_pairs, unit_cube


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
    coarsest = next(side for side in sides if occupied(side) >= 0.6 * n)
    assert structure.levels[0].num_cells == occupied(coarsest) > occupied(coarsest // 2)


@pytest.mark.parametrize("spread", [1, 3, 100, 2**16 - 1])
def test_neighbour_pairs_are_those_of_brute_force_in_order(spread):
    g = torch.Generator().manual_seed(4)
    cells = torch.cat([torch.randint(0, 8, (120, 3), generator=g), torch.tensor([[0, 0, 0], [spread] * 3])])
    cells = torch.unique(torch.cat([cells, spread - cells.clamp(max=spread)]), dim=0).clamp(0, spread)
    cells = torch.unique(cells, dim=0)
    cells = cells[torch.randperm(len(cells), generator=g)]
    expected = []
    for offset in HALF_KERNEL:
        match = (cells[:, None] + torch.tensor(offset) == cells[None]).all(dim=-1)
        expected.append(match.nonzero().T.tolist())
    assert [[i.tolist(), j.tolist()] for i, j in neighbour_pairs(cells)] == expected


def features(n: int = 30):
    scene = normal_scene(n)
    return gaussian_features(scene, unit_cube(scene.means), 15, torch.float32)


@pytest.mark.parametrize("unit_gate", [False, True])
def test_the_encoder_is_equations_4_to_6_written_out(unit_gate):
    torch.manual_seed(0)
    encoder = DualBranchEncoder(preset("full", unit_gate=unit_gate)).eval()
    f = features()
    f_p = torch.cat([f.positions, f.quats, f.scales], dim=1)
    f_a = torch.cat([f.opacities, f.features_dc, encoder.color(f.features_rest)], dim=1)
    assert (f_p.shape[1], f_a.shape[1]) == (10, 12)
    delta = encoder.position(f.positions)
    weight = (encoder.appearance(f_a) + delta).exp()
    weight = weight / weight.sum(dim=1, keepdim=True) * (32 if unit_gate else 1)
    expected = weight * (encoder.geometry(f_p) + delta)
    assert torch.allclose(encoder(f), expected, atol=1e-6)  # float32 softmax, values of order 1


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def grid_cells(side: int) -> torch.Tensor:
    return torch.tensor(list(itertools.product(range(side), repeat=3)))


def test_submanifold_convolution_equals_dense_with_zeros_elsewhere():
    side, cin, cout = 8, 2, 3
    cells = grid_cells(side)[torch.randperm(side**3, generator=seeded())[:90]]
    x = torch.randn(90, cin, dtype=torch.float64, generator=seeded(1))
    weight = torch.randn(27, cin, cout, dtype=torch.float64, generator=seeded(2))
    dense = torch.zeros(cin, side, side, side, dtype=torch.float64)
    at = (slice(None), *cells.T)
    dense[at] = x.T
    expected = F.conv3d(dense[None], weight.reshape(3, 3, 3, cin, cout).permute(4, 3, 0, 1, 2), padding=1)[0][at].T
    assert torch.allclose(submanifold_conv(x, weight, neighbour_pairs(cells)), expected, atol=1e-12)


def test_submanifold_convolution_passes_gradcheck():
    cells = grid_cells(3)[torch.randperm(27, generator=seeded())[:9]]
    x = torch.randn(9, 2, dtype=torch.float64, generator=seeded(1), requires_grad=True)
    weight = torch.randn(27, 2, 3, dtype=torch.float64, generator=seeded(2), requires_grad=True)
    pairs = neighbour_pairs(cells)
    assert torch.autograd.gradcheck(lambda a, b: submanifold_conv(a, b, pairs), (x, weight))


def test_permute_passes_gradcheck_and_indexes():
    order = torch.randperm(7, generator=seeded())
    x = torch.randn(7, 2, dtype=torch.float64, generator=seeded(1), requires_grad=True)
    assert torch.equal(permute(x, order, order.argsort()), x[order])
    assert torch.autograd.gradcheck(lambda a: permute(a, order, order.argsort()), (x,))


@pytest.mark.parametrize(("segment", "reduce"), [(segment_max, torch.amax), (segment_mean, torch.mean)])
def test_segments_are_reduced_as_by_a_loop_and_pass_gradcheck(segment, reduce):
    cluster = torch.tensor([0, 2, 1, 2, 0, 2])
    x = torch.randn(6, 3, dtype=torch.float64, generator=seeded(), requires_grad=True)
    expected = torch.stack([reduce(x[cluster == c], 0) for c in range(3)])
    assert torch.allclose(segment(x, cluster, 3), expected, rtol=1e-15)
    assert torch.autograd.gradcheck(lambda a: segment(a, cluster, 3), (x,))


@pytest.mark.parametrize("size", ["tiny", "small"])
def test_the_refiner_gives_the_same_in_pieces_of_any_size(size, monkeypatch):
    scene = normal_scene(700, dtype=torch.float64)
    torch.manual_seed(0)
    refiner = move_zero_layers(Refiner(preset(size, patch=100)).double())
    scenes, grads = [], []
    for cells in (2**30, 2**13):
        monkeypatch.setattr(sparse_ops, "MAX_ELEMENTS", cells)
        refiner.zero_grad()
        torch.manual_seed(1)
        refined = refiner.train()(scene)
        sum(value.square().sum() for value in refined.tensors()).backward()
        with torch.no_grad():
            scenes.append([*refined.tensors(), *refiner.eval()(scene).tensors()])
        grads.append([p.grad.clone() for p in refiner.parameters()])
    # float64: only the order of sums differs; gradients sum 700 rows of values up to some hundred
    assert all(torch.allclose(a, b, rtol=1e-9, atol=1e-10) for a, b in zip(*scenes, strict=True))
    assert all(torch.allclose(a, b, rtol=1e-7, atol=1e-7) for a, b in zip(*grads, strict=True))
