"""Rotation matrices of quaternions against scipy, and at the extremes."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from pointsplat_ns.geometry.quaternions import rotation_components, rotation_matrices, zero_as_identity


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


def test_both_layouts_hold_the_same_matrices():
    unit = torch.nn.functional.normalize(random_quats(), dim=1)
    found = rotation_components(unit.T.contiguous()).permute(2, 0, 1)
    torch.testing.assert_close(found, rotation_matrices(unit), rtol=0, atol=1e-14)  # it normalises once more


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_zero_quaternion_is_the_identity(dtype):
    zero = torch.zeros(1, 4, dtype=dtype)
    assert torch.equal(rotation_matrices(zero)[0], torch.eye(3, dtype=dtype))
    assert torch.equal(rotation_components(zero.T)[..., 0], torch.eye(3, dtype=dtype))
    assert zero_as_identity(zero).tolist() == [[1.0, 0.0, 0.0, 0.0]]


def test_a_length_that_underflows_is_the_identity():
    assert torch.equal(rotation_matrices(torch.full((1, 4), 1e-320, dtype=torch.float64))[0], torch.eye(3).double())


def test_other_quaternions_stay_as_they_are_to_the_bit():
    quats = random_quats()
    quats[3, 1:] = 0.0
    assert torch.equal(zero_as_identity(quats), quats)


def test_no_quaternions_have_no_matrices():
    assert rotation_matrices(torch.empty(0, 4)).shape == (0, 3, 3)
