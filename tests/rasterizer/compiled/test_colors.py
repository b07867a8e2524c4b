"""Compiled kernels give the colours that torch gives, with the same gradients."""

import math

import pytest
import torch

from making import assert_same_on_any_threads
from pointsplat_ns.rasterizer.compiled import colors as compiled_colors
from pointsplat_ns.rasterizer.spherical_harmonics import sh_to_color

F32, F64 = torch.float32, torch.float64

missing = compiled_colors.KERNELS.why_missing
needs_compiler = pytest.mark.skipif(bool(missing), reason=missing)


def inputs(stored=17, n=500, m=300):
    """Directions (M, 3) of any length, one of them zero, coefficients (N, K, 3), and rows in no order, float64 numbers
    that float32 holds."""
    g = torch.Generator().manual_seed(5)
    directions = torch.randn(m, 3, generator=g) * 10.0 ** torch.linspace(-20, 20, m)[:, None]
    directions[7] = 0
    coefficients = torch.randn(n, stored, 3, generator=g)
    return directions.double(), coefficients.double(), torch.randperm(n, generator=g)[:m]


def colored(directions, coefficients, ids, degree, dtype, compiled):
    """Colours, and the gradients of a fixed sum of them, in float64; those of directions by unit of their length."""
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in (directions, coefficients)]
    colors = sh_to_color(*leaves, degree, ids, compiled)
    weights = torch.randn(colors.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
    grads = torch.autograd.grad((colors * weights).sum(), leaves, allow_unused=True)
    of_directions = None if grads[0] is None else grads[0].double() * directions.norm(dim=1, keepdim=True)
    return colors.detach().double(), of_directions, grads[1].double()


@needs_compiler
@pytest.mark.parametrize("extra", [0, 1])
@pytest.mark.parametrize("degree", range(4))
def test_colours_and_gradients_are_those_of_torch_and_as_near_to_float64(degree, extra):
    given = inputs(stored=(degree + 1) ** 2 + extra)
    ours, torchs, exact = (colored(*given, degree, *how) for how in ((F32, True), (F32, False), (F64, False)))
    assert (ours[0] == 0).any() and (ours[0] > 0).any()
    assert (ours[1] is None) == (torchs[1] is None) == (degree == 0)  # a constant has no direction
    for mine, theirs, right in zip(ours, torchs, exact, strict=True):
        if mine is not None:
            # a colour at 0 may fall on either side, and take its gradient with it: none does here
            assert mine.isfinite().all() and (mine - right).abs().max() <= 2e-6 * right.abs().max()
            assert (mine - right).norm() <= 2 * (theirs - right).norm() + 1e-7 * right.norm()
    rest = torch.ones(len(given[1]), dtype=torch.bool).index_fill_(0, given[2], False)
    assert not ours[2][rest].any() and not ours[2][:, (degree + 1) ** 2 :].any()


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("degree", range(4))
def test_coefficients_apart_give_the_bits_of_those_together(degree, compiled):
    directions, coefficients, ids = inputs(stored=(degree + 1) ** 2 + 1)
    weights, results = torch.randn(len(ids), 3), []
    for apart in (False, True):
        leaves = [tensor.float().requires_grad_() for tensor in (directions, coefficients)]
        first, rest = leaves[1][:, 0], leaves[1][:, 1:]
        colors = sh_to_color(leaves[0], (first, rest) if apart else leaves[1], degree, ids, compiled)
        grads = torch.autograd.grad((colors * weights).sum(), leaves, allow_unused=True, materialize_grads=True)
        results.append((colors, *grads))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True)) and results[0][2].any()


@needs_compiler
@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_makes_nan_of_its_own_colour_and_of_no_other(wrong):
    directions, coefficients, ids = inputs(stored=16)
    coefficients[ids[3], 2, 1] = wrong
    coefficients[ids[4], 9:] = wrong  # of a degree that is not evaluated
    directions[5, 0] = wrong
    got, wanted = (colored(directions, coefficients, ids, 2, F32, compiled)[0] for compiled in (True, False))
    expected = torch.zeros_like(got, dtype=torch.bool)
    expected[3, 1] = expected[5] = True
    assert torch.equal(got.isnan(), expected) and torch.equal(wanted.isnan(), expected)
    assert (got - wanted)[~expected].abs().max() <= 2e-6


@needs_compiler
def test_no_direction_gives_no_colour_and_rows_that_are_not_there_are_refused():
    directions, coefficients, ids = (t.float() if t.is_floating_point() else t for t in inputs())
    coefficients.requires_grad_()
    nothing = sh_to_color(directions[:0], coefficients, 3, ids[:0])
    assert nothing.shape == (0, 3) and not torch.autograd.grad(nothing.sum(), coefficients)[0].any()
    for wrong in (-1, len(coefficients)):
        with pytest.raises(IndexError, match=f"ids are from .*{wrong}.*expected rows of 500 Gaussians"):
            sh_to_color(directions[:2], coefficients, 3, torch.tensor([3, wrong]))


@needs_compiler
def test_any_number_of_threads_gives_the_same_bits():
    given = inputs(stored=16, n=9000, m=6000)
    assert_same_on_any_threads(lambda: colored(*given, 3, F32, True))
