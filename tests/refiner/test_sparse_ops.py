import itertools

import pytest
import torch
import torch.nn.functional as F

from pointsplat_ns.refiner.sparse_ops import permute, segment_max, segment_mean, submanifold_conv
from pointsplat_ns.refiner.structure import HALF_KERNEL, neighbour_pairs


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def grid_cells(side: int) -> torch.Tensor:
    return torch.tensor(list(itertools.product(range(side), repeat=3)))


def test_half_kernel_and_its_mirror_are_the_26_neighbours_in_tap_order():
    taps = list(itertools.product((-1, 0, 1), repeat=3))
    assert HALF_KERNEL == taps[14:]
    assert [tuple(-d for d in offset) for offset in HALF_KERNEL] == taps[12::-1]


def test_submanifold_convolution_on_scattered_cells_equals_dense_with_zeros_elsewhere():
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


def test_neighbours_do_not_wrap_around_the_ends_of_the_grid():
    cells = torch.tensor([[0, 0, 0], [0, 0, 65535], [0, 65535, 0], [65535, 65535, 65535], [1, 0, 0]])
    found = [(i.tolist(), j.tolist()) for i, j in neighbour_pairs(cells) if len(i)]
    assert found == [([0], [4])]


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


def test_segment_max_of_equal_rows_shares_the_gradient():
    x = torch.full((4, 1), -3.0, requires_grad=True)
    segment_max(x, torch.zeros(4, dtype=torch.long), 1).sum().backward()
    assert x.grad.tolist() == [[0.25]] * 4
