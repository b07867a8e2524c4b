import pytest
import torch

from making import move_zero_layers, normal_scene
from pointsplat_ns.refiner import Refiner, preset, sparse_ops
from pointsplat_ns.refiner.sparse_ops import MAX_ELEMENTS, by_rows, rows_at_a_time


@pytest.mark.parametrize("width,multiple", [(64, 1), (192, 1024), (3 * 512, 1024), (10 * MAX_ELEMENTS, 7)])
def test_rows_fill_the_cells_in_multiples(width, multiple):
    rows = rows_at_a_time(width, multiple)
    assert rows % multiple == 0
    assert rows * width <= MAX_ELEMENTS < (rows + multiple) * width or rows == multiple


@pytest.mark.parametrize("n", [0, 1, 7, 8, 9, 16, 23])
@pytest.mark.parametrize("grad", [False, True])
def test_parts_make_the_whole(n, grad):
    x = torch.randn(n, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    taken = []

    def function(part):
        taken.append(len(part))
        return (part * 2).sum(dim=1, keepdim=True)

    with torch.set_grad_enabled(grad):
        out = by_rows(function, x, 8)
    assert torch.equal(out, (x * 2).sum(dim=1, keepdim=True))
    assert sum(taken) == n and max(taken) <= 8


@pytest.mark.parametrize("size", ["tiny", "small"])
def test_the_refiner_gives_the_same_scene_and_gradients_whatever_goes_at_once(size, monkeypatch):
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
