"""Input features, and the parts of the network."""

import itertools

import pytest
import torch
import torch.nn.functional as F

from making import move_zero_layers, normal_scene
from pointsplat_ns.refinement import Refiner, refiner_preset, sparse_ops
from pointsplat_ns.refinement.network import (
    BatchNorm,
    Block,
    PatchAttention,
    SceneNorm,
    SubmanifoldConv,
)
from pointsplat_ns.refinement.refiner import canonical_quats, gaussian_features
from pointsplat_ns.refinement.sparse_ops import (
    by_patches,
    permute,
    segment_max,
    segment_mean,
    submanifold_conv,
)
from pointsplat_ns.refinement.structure import build_structure, neighbour_pairs, unit_cube
from pointsplat_ns.scene.gaussians import Gaussians


@pytest.mark.parametrize("length", [1e-35, 1e-20, 1.0, 1e20, 1e38])
def test_quaternions_of_any_length_become_unit_and_are_recovered(length):
    q = torch.randn(100, 4, generator=torch.Generator().manual_seed(0)).clamp(-1.6, 1.6) * length
    unit, scale = canonical_quats(q)
    # A few float32 roundings; those of the smallest components of the shortest are subnormal,
    # multiples of 1.4e-45.
    assert torch.allclose(unit.norm(dim=1), torch.ones(100), atol=5e-7)
    assert torch.allclose(unit * scale, q, rtol=5e-7, atol=1e-44)


@pytest.mark.parametrize(("raw", "most"), [(False, 8), (True, 17)])
def test_features_of_extreme_parameters_are_finite_and_bounded(raw, most):
    n = 6
    inf = torch.inf
    scene = Gaussians(
        means=torch.tensor(
            [[0.0, 0, 0], [1, 1, 1], [1e6, 0, 0], [0, -1e6, 0], [2, 2, 2], [3, 3, 3]]
        ),
        scales=torch.tensor([80.0, -80, -inf, 0, -5, 88])[:, None].expand(n, 3).clone(),
        quats=torch.tensor(
            [[0.0, 0, 0, 0], [1e30, 0, 0, 0], [1e-30, 0, 0, -1e-30], [1, 1, 1, 1]] * 2
        )[:n],
        opacities=torch.tensor([inf, -inf, 40, -40, 0, 1])[:, None],
        features_dc=torch.full((n, 3), 1e30),
        features_rest=torch.full((n, 3, 3), -1e30),
    )
    scene = scene.map(lambda value: value.clone().requires_grad_())
    features = gaussian_features(
        scene, unit_cube(scene.means), num_rest=15, dtype=torch.float32, raw=raw
    )
    total = 0
    for name in ("positions", "quats", "scales", "opacities", "features_dc", "features_rest"):
        value = getattr(features, name)
        assert value.isfinite().all() and value.abs().max() <= most, name
        total = total + value.sum()
    assert features.features_rest.shape == (n, 45)
    assert (features.features_rest[:, 9:] == 0).all()
    total.backward()
    for name, value in scene.items():
        assert value.grad.isfinite().all(), name


def test_raw_features_are_the_numbers_of_the_scene_in_a_unit_cube():
    scene = normal_scene(50)
    cube = unit_cube(scene.means)
    features = gaussian_features(scene, cube, num_rest=15, dtype=torch.float32, raw=True)
    assert torch.allclose(features.scales, scene.scales - cube.extent.float().log(), atol=1e-5)
    assert torch.equal(features.opacities, scene.opacities) and torch.equal(
        features.features_dc, scene.features_dc
    )
    usual = gaussian_features(scene, cube, num_rest=15, dtype=torch.float32)
    assert torch.allclose(features.scales, 2 * usual.scales - 5, atol=1e-5)
    assert torch.equal(features.positions, usual.positions) and torch.equal(
        features.quats, usual.quats
    )
    seen = []
    refiner = Refiner(refiner_preset("tiny", raw_inputs=True)).eval()
    refiner.encoder.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    refiner(scene)
    assert torch.equal(seen[0].opacities.sort(dim=0).values, features.opacities.sort(dim=0).values)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plain_attention(module: PatchAttention, x: torch.Tensor) -> torch.Tensor:
    """Softmax attention written out, over all rows."""
    m, c = x.shape
    q, k, v = module.qkv(x).view(m, 3, module.heads, c // module.heads).permute(1, 2, 0, 3)
    weight = torch.softmax(q @ k.transpose(1, 2) / (c // module.heads) ** 0.5, dim=-1)
    return module.proj((weight @ v).transpose(0, 1).reshape(m, c))


@pytest.mark.parametrize(("n", "patch"), [(1, 6), (20, 20), (20, 64), (15, 6)])
def test_patches_attend_within_themselves_and_the_last_borrows(n, patch):
    torch.manual_seed(0)
    module = PatchAttention(12, 3, patch).double()
    x = torch.randn(n, 12, dtype=torch.float64)
    order = torch.randperm(n)
    for along in (None, order):
        inner = x if along is None else x[along]
        whole = [plain_attention(module, part) for part in inner.split(patch)]
        if n % patch and n > patch:
            whole[-1] = plain_attention(module, inner[n - patch :])[-(n % patch) :]
        found = by_patches(
            module, x, 36, patch, None if along is None else (along, along.argsort())
        )
        assert torch.allclose(
            found if along is None else found[along], torch.cat(whole), atol=1e-12
        )


def test_points_of_a_cell_get_the_dense_convolution_of_their_mean():
    config = refiner_preset("full", grid=4)
    means = torch.rand(40, 3, generator=seeded())
    structure = build_structure(normal_scene(40).replace(means=means), config)
    level = structure.levels[0]
    assert level.cell_of is not None
    torch.manual_seed(0)
    conv = SubmanifoldConv(3, 5).double()
    with torch.no_grad():
        conv.bias.normal_()
    x = torch.randn(40, 3, dtype=torch.float64)
    cells = (
        ((structure.cube.positions(means)[structure.order] + 0.5) * 4).floor().clamp(max=3).long()
    )
    total = torch.zeros(3, 4, 4, 4, dtype=torch.float64)
    count = torch.zeros(4, 4, 4, dtype=torch.float64)
    for row, (i, j, k) in zip(x, cells.tolist(), strict=True):
        total[:, i, j, k] += row
        count[i, j, k] += 1
    kernel = conv.weight.reshape(3, 3, 3, 3, 5).permute(4, 3, 0, 1, 2)
    dense = F.conv3d((total / count.clamp(min=1))[None], kernel, conv.bias, padding=1)[0]
    assert torch.allclose(
        conv(x, level), dense[:, cells[:, 0], cells[:, 1], cells[:, 2]].T, atol=1e-12
    )


def test_drop_path_acts_in_training_only_and_keeps_the_mean():
    torch.manual_seed(0)
    block = Block(8, 2, refiner_preset("tiny"), drop_path=0.4)
    x = torch.ones(20000, 1)
    dropped = block.train()._drop(x)
    assert set(dropped.unique().tolist()) == {0.0, torch.tensor(1 / 0.6).item()}
    assert abs(dropped.mean() - 1) < 0.03  # five standard errors of 0.006
    assert block.eval()._drop(x) is x


def test_batch_norm_equals_torch_in_training_and_takes_a_single_point():
    ours = BatchNorm(4)
    theirs = torch.nn.BatchNorm1d(4, eps=1e-3)
    x = torch.randn(30, 4, generator=seeded()) * 3 + 2
    assert torch.equal(ours(x), theirs(x))
    one = ours.train()(x[:1])
    assert torch.equal(one, ours.eval()(x[:1])) and one.isfinite().all()


@pytest.mark.parametrize("offset,spread", [(0.0, 1e-12), (1e4, 1.0), (0.0, 1e15)])
def test_scene_norm_at_extremes_follows_float64(offset, spread):
    x = torch.randn(500, 3, generator=seeded(), dtype=torch.float64) * spread + offset
    results = []
    for dtype in (torch.float32, torch.float64):
        norm = SceneNorm(3).to(dtype)
        leaf = x.to(dtype).requires_grad_()
        out = norm(leaf)
        out.square().sum().backward()
        assert out.isfinite().all() and leaf.grad.isfinite().all()
        results.append(out.double())
    # at 1e4 float32 steps are a thousandth of the spread, and the mean is known to a few of them
    assert (results[0] - results[1]).abs().max() < 2e-2


def test_submanifold_convolution_passes_gradcheck():
    cells = torch.tensor(list(itertools.product(range(3), repeat=3)))[
        torch.randperm(27, generator=seeded())[:9]
    ]
    x = torch.randn(9, 2, dtype=torch.float64, generator=seeded(1), requires_grad=True)
    weight = torch.randn(27, 2, 3, dtype=torch.float64, generator=seeded(2), requires_grad=True)
    pairs = neighbour_pairs(cells)
    assert torch.autograd.gradcheck(lambda a, b: submanifold_conv(a, b, pairs), (x, weight))


def test_permute_passes_gradcheck_and_indexes():
    order = torch.randperm(7, generator=seeded())
    x = torch.randn(7, 2, dtype=torch.float64, generator=seeded(1), requires_grad=True)
    assert torch.equal(permute(x, order, order.argsort()), x[order])
    assert torch.autograd.gradcheck(lambda a: permute(a, order, order.argsort()), (x,))


@pytest.mark.parametrize(
    ("segment", "reduce"), [(segment_max, torch.amax), (segment_mean, torch.mean)]
)
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
    refiner = move_zero_layers(Refiner(refiner_preset(size, patch=100)).double())
    scenes = []
    grads = []
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
