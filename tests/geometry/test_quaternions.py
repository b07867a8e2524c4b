"""Rotation matrices of quaternions against scipy, and at the extremes."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from lab.numerics import reference
from pointsplat_ns.geometry.transforms import (
    SHORTEST,
    quaternions_of,
    rotation_components,
    rotation_matrices,
    unit_rows,
    zero_as_identity,
)
from pointsplat_ns.refinement.refiner import canonical_quats


def random_quats(n=200, dtype=torch.float64):
    return torch.randn(n, 4, generator=torch.Generator().manual_seed(0), dtype=dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
@pytest.mark.parametrize("length", [SHORTEST, 1e-30, 1.0, 1e30])
def test_rotation_matrices_are_those_of_scipy_whatever_the_length(length, dtype, tolerance):
    quats = random_quats(dtype=dtype)
    quats = quats / quats.abs().amax(dim=1, keepdim=True)
    wanted = torch.from_numpy(
        Rotation.from_quat(quats[:, [1, 2, 3, 0]].double().numpy()).as_matrix()
    )
    found = rotation_matrices(quats * length)
    # A few roundings of numbers up to 1; small components of the shortest are subnormal, to 1e-7 of
    # the largest.
    assert found.dtype == dtype and (found - wanted).abs().max() < tolerance


def test_quaternions_of_matrices_are_those_that_made_them_up_to_sign():
    """Half turns too, where the real part is 0."""
    quats = random_quats()
    quats = torch.cat(
        [quats, torch.eye(4, dtype=torch.float64), quats * torch.tensor([1e-9, 1.0, 1.0, 1.0])]
    )
    quats = torch.nn.functional.normalize(quats, dim=1)
    found = quaternions_of(rotation_matrices(quats).view(4, -1, 3, 3)).view(-1, 4)
    alike = (found * quats).sum(1)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(len(quats), dtype=torch.float64))
    torch.testing.assert_close(
        found * alike.sign()[:, None], quats, rtol=0, atol=1e-9
    )  # as far as the real parts go


def turned_by_each(quats: torch.Tensor) -> dict[str, torch.Tensor]:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in each place that turns by them, some with
    gradients."""
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
        torch.testing.assert_close(
            turned.double(), turned_by_each(short.double())[name], rtol=0, atol=1e-6
        )


def test_short_quaternions_have_no_gradient_and_others_that_of_float64():
    lengths = torch.tensor([0.0, 1e-40, 1.1e-38, 1e-36, 1e-20, 1.0])
    quats = torch.nn.functional.normalize(random_quats(6, torch.float32), dim=1) * lengths[:, None]
    grads = {}
    for dtype in (torch.float32, torch.float64):
        for name in ("covariances", "refiner's features", "reference", "refined"):
            leaf = quats.detach().to(dtype, copy=True).requires_grad_()
            turned_by_each(leaf)[name][:, 0, 1].sum().backward()
            grads[name, dtype] = leaf.grad.double() * lengths.double()[:, None]
            assert (
                not leaf.grad[:3].any()
                and leaf.grad[3:].isfinite().all()
                and leaf.grad[3:].any(1).all()
            ), name
    first = grads["covariances", torch.float64]
    for case, grad in grads.items():
        # 1e-36 has components to 1e-9; the rest is float32's rounding.
        assert torch.allclose(grad, first, rtol=1e-4, atol=1e-5), case
