import pytest
import torch
import torch.nn.functional as F

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.config import preset
from pointsplat_ns.refiner.network import BatchNorm, Block, PatchAttention, SceneNorm, SubmanifoldConv
from pointsplat_ns.refiner.sparse_ops import by_patches
from pointsplat_ns.refiner.structure import build_structure


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def structure_of(means: torch.Tensor, config):
    n = len(means)
    tails = ((3,), (4,), (1,), (3,), (0, 3))
    return build_structure(Gaussians(means, *(torch.zeros(n, *tail) for tail in tails)), config)


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
    x, order = torch.randn(n, 12, dtype=torch.float64), torch.randperm(n)
    for along in (None, order):
        inner = x if along is None else x[along]
        whole = [plain_attention(module, part) for part in inner.split(patch)]
        if n % patch and n > patch:
            whole[-1] = plain_attention(module, inner[n - patch :])[-(n % patch) :]
        found = by_patches(module, x, 36, patch, None if along is None else (along, along.argsort()))
        assert torch.allclose(found if along is None else found[along], torch.cat(whole), atol=1e-12)


def test_points_of_a_cell_get_the_convolution_of_their_mean():
    config = preset("full", grid=4)
    means = torch.rand(40, 3, generator=seeded())
    structure = structure_of(means, config)
    level = structure.levels[0]
    assert level.cell_of is not None
    torch.manual_seed(0)
    conv = SubmanifoldConv(3, 5).double()
    with torch.no_grad():
        conv.bias.normal_()
    x = torch.randn(40, 3, dtype=torch.float64)
    cells = ((structure.cube.positions(means)[structure.order] + 0.5) * 4).floor().clamp(max=3).long()
    total, count = torch.zeros(3, 4, 4, 4, dtype=torch.float64), torch.zeros(4, 4, 4, dtype=torch.float64)
    for row, (i, j, k) in zip(x, cells.tolist(), strict=True):
        total[:, i, j, k] += row
        count[i, j, k] += 1
    kernel = conv.weight.reshape(3, 3, 3, 3, 5).permute(4, 3, 0, 1, 2)
    dense = F.conv3d((total / count.clamp(min=1))[None], kernel, conv.bias, padding=1)[0]
    assert torch.allclose(conv(x, level), dense[:, cells[:, 0], cells[:, 1], cells[:, 2]].T, atol=1e-12)


def test_drop_path_acts_in_training_only_and_keeps_the_mean():
    torch.manual_seed(0)
    block = Block(8, 2, preset("tiny"), drop_path=0.4)
    x = torch.ones(20000, 1)
    dropped = block.train()._drop(x)
    assert set(dropped.unique().tolist()) == {0.0, torch.tensor(1 / 0.6).item()}
    assert abs(dropped.mean() - 1) < 0.03  # five standard errors of 0.006
    assert block.eval()._drop(x) is x


def test_batch_norm_equals_torch_in_training_and_takes_a_single_point():
    ours, theirs = BatchNorm(4), torch.nn.BatchNorm1d(4, eps=1e-3)
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
