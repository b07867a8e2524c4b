"""Rotation matrices of quaternions against scipy, and at the extremes."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from pointsplat_ns.geometry.transforms import (
    SHORTEST,
    quaternions_of,
    rotation_components,
    rotation_matrices,
    zero_as_identity,
)
from pointsplat_ns.rasterizer import rasterization, reference
from pointsplat_ns.rasterizer.spherical_harmonics import unit_rows
from pointsplat_ns.refiner.refiner import canonical_quats


def random_quats(n=200, dtype=torch.float64):
    return torch.randn(n, 4, generator=torch.Generator().manual_seed(0), dtype=dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
@pytest.mark.parametrize("length", [1e-15, 1.0, 1e15])
def test_rotation_matrices_are_those_of_scipy_whatever_the_length(length, dtype, tolerance):
    quats = random_quats(dtype=dtype)
    wanted = torch.from_numpy(Rotation.from_quat(quats[:, [1, 2, 3, 0]].double().numpy()).as_matrix())
    found = rotation_matrices(quats * length)
    # A few roundings of numbers up to 1.
    assert found.dtype == dtype and (found - wanted).abs().max() < tolerance


def test_quaternions_of_matrices_are_those_that_made_them_up_to_sign():
    """Half turns too, where the real part is 0."""
    quats = random_quats()
    quats = torch.cat([quats, torch.eye(4, dtype=torch.float64), quats * torch.tensor([1e-9, 1.0, 1.0, 1.0])])
    quats = torch.nn.functional.normalize(quats, dim=1)
    found = quaternions_of(rotation_matrices(quats).view(4, -1, 3, 3)).view(-1, 4)
    alike = (found * quats).sum(1)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(len(quats), dtype=torch.float64))
    torch.testing.assert_close(found * alike.sign()[:, None], quats, rtol=0, atol=1e-9)  # as far as the real parts go


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [SHORTEST, 1e-30, 1e-20, 1e30])
def test_the_shortest_and_longer_turn_as_those_of_length_one(length, dtype):
    quats = random_quats(dtype=dtype)
    quats = quats / quats.abs().amax(dim=1, keepdim=True)
    found, wanted = rotation_matrices(quats * length), rotation_matrices(quats)
    # Small components of the shortest are subnormal: float32 has them to 1e-7 of the largest.
    assert (found - wanted).abs().max() < (1e-6 if dtype == torch.float32 else 1e-14)
    assert torch.equal(zero_as_identity(quats * length), quats * length)


def turned_by_each(quats: torch.Tensor) -> dict[str, torch.Tensor]:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in each place that turns by them, some with gradients."""
    unit, _ = unit_rows(quats.T.contiguous())
    canonical, _ = canonical_quats(quats)
    return {
        "covariances": rotation_matrices(quats),
        "rasterizer": rotation_components(unit).permute(2, 0, 1),
        "refiner's features": rotation_components(canonical.T).permute(2, 0, 1),
        "reference": torch.stack([reference._rotation(quat) for quat in quats]),
        "refined": rotation_matrices(zero_as_identity(quats)),
    }


def test_short_quaternions_mean_the_same_everywhere_in_any_precision():
    lengths = torch.tensor([0.0, 1e-45, 1e-40, 1.1e-38, SHORTEST, 2e-38, 1e-30, 1e-20, 1.0])
    short = torch.nn.functional.pad(lengths[:, None], (2, 1))  # half a turn about y
    for name, turned in turned_by_each(short).items():
        identity = torch.tensor([bool(torch.equal(matrix, torch.eye(3))) for matrix in turned])
        assert identity.tolist() == [True] * 4 + [False] * 5, name
        torch.testing.assert_close(turned.double(), turned_by_each(short.double())[name], rtol=0, atol=1e-6)


def test_short_quaternions_have_no_gradient_and_others_that_of_float64():
    lengths = torch.tensor([0.0, 1e-40, 1.1e-38, 1e-36, 1e-20, 1.0])
    quats = torch.nn.functional.normalize(random_quats(6, torch.float32), dim=1) * lengths[:, None]
    grads = {}
    for dtype in (torch.float32, torch.float64):
        for name in ("covariances", "refiner's features", "reference", "refined"):
            leaf = quats.detach().to(dtype, copy=True).requires_grad_()
            turned_by_each(leaf)[name][:, 0, 1].sum().backward()
            grads[name, dtype] = leaf.grad.double() * lengths.double()[:, None]
            assert not leaf.grad[:3].any() and leaf.grad[3:].isfinite().all() and leaf.grad[3:].any(1).all(), name
    first = grads["covariances", torch.float64]
    for case, grad in grads.items():
        # 1e-36 has components to 1e-9; the rest is float32's rounding.
        assert torch.allclose(grad, first, rtol=1e-4, atol=1e-5), case


def test_other_quaternions_stay_as_they_are_to_the_bit():
    quats = random_quats()
    quats[3, 1:] = 0.0
    assert torch.equal(zero_as_identity(quats), quats)


def test_the_rasterizer_draws_short_quaternions_in_float32_as_in_float64():
    quats = random_quats(6, torch.float32) * torch.tensor([0.0, 1e-40, 5e-39, 1e-36, 1e-20, 1.0])[:, None]
    means = torch.stack([torch.linspace(-1, 1, 6), torch.zeros(6), torch.full((6,), 3.0)], dim=1)
    stds, K = torch.tensor([0.2, 0.05, 0.02]).expand(6, 3), torch.tensor([[40.0, 0, 24], [0, 40, 12], [0, 0, 1]])
    images, grads = [], []
    for dtype in (torch.float32, torch.float64):
        leaf = quats.to(dtype, copy=True).requires_grad_()
        values = [value.to(dtype) for value in (stds, torch.full((6,), 0.8), torch.eye(6)[:, :3], torch.eye(4)[None])]
        images.append(rasterization(means.to(dtype), leaf, *values, K.to(dtype)[None], 48, 24)[0])
        (images[-1] * torch.linspace(0, 1, 48, dtype=dtype)[:, None]).sum().backward()
        grads.append(leaf.grad.double() * quats.double().norm(dim=1, keepdim=True))
    # as float32 rasterization is tested elsewhere
    torch.testing.assert_close(images[0].double(), images[1], rtol=0, atol=1e-5)
    assert not grads[0][:3].any() and not grads[1][:3].any()
    torch.testing.assert_close(*grads, rtol=1e-3, atol=1e-4)
