"""Transforms of a scene: what they mean in pictures, and that they are undone."""

import math

import pytest
import torch

from making import normal_scene
from pointsplat_ns.geometry.harmonics import sh_matrix
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis
from pointsplat_ns.refiner.augmentation import Transform, random_transform


def a_scene(n=40, sh_degree=3, dtype=torch.float64, seed=0):
    scene = normal_scene(n, sh_degree, seed, dtype)
    return scene.replace(
        scales=0.5 * scene.scales - 2, features_dc=0.3 * scene.features_dc, features_rest=0.1 * scene.features_rest
    )


def picture(scene, viewmat):
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 24], [0, 0, 1]], dtype=scene.dtype)
    image, alpha, _ = rasterization(
        scene.means, scene.quats, scene.stds, scene.alphas, scene.sh, viewmat[None], K[None], 48, 48,
        sh_degree=scene.sh_degree,
    )  # fmt: skip
    return image[0], alpha[0]


def camera():
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 6.0
    return viewmat


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_undo_gives_the_scene_back(seed, sh_degree):
    scene = a_scene(sh_degree=sh_degree, seed=seed)
    transform = random_transform(torch.Generator().manual_seed(seed))
    back = transform.undo(transform.apply(scene))
    for (name, value), found in zip(scene.items(), back.tensors(), strict=True):
        assert torch.allclose(found, value, atol=1e-12), name


@pytest.mark.parametrize("seed", range(6))
def test_a_turned_scene_looks_the_same_to_a_turned_camera(seed):
    scene = a_scene(seed=seed)
    drawn = random_transform(torch.Generator().manual_seed(seed))
    turn = Transform(drawn.quat, False, torch.ones(3, dtype=torch.float64), torch.arange(3))
    viewmat = camera()
    turned = viewmat.clone()
    turned[:3, :3] = viewmat[:3, :3] @ turn.matrix.T
    before, after = picture(scene, viewmat), picture(turn.apply(scene), turned)
    for a, b in zip(before, after, strict=True):
        # A pixel at a threshold of alpha may fall on the other side of it by rounding: 1/255 of it then shows.
        assert (a - b).abs().max() < 5e-3
        assert (a - b).abs().mean() < 1e-5


def test_a_mirrored_scene_looks_mirrored():
    scene = a_scene(seed=3)
    mirror = Transform(torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), True, torch.ones(3).double(), torch.arange(3))
    viewmat = camera()
    opposite = viewmat.clone()
    # A camera on the other side, turned half about y, sees what was at (x, y, z) at (x, -y, z): upside down.
    opposite[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    before, after = picture(scene, viewmat), picture(mirror.apply(scene), opposite)
    for a, b in zip(before, after, strict=True):
        assert (a - b.flip(0)).abs().max() < 5e-3
        assert (a - b.flip(0)).abs().mean() < 1e-5


def test_colours_are_multiplied_and_exchanged():
    scene = a_scene(seed=1).replace(features_dc=torch.full((40, 3), 0.5, dtype=torch.float64))  # nowhere below 0
    scene = scene.replace(features_rest=0.05 * scene.features_rest)
    gains = torch.tensor([0.7, 1.0, 1.4], dtype=torch.float64)
    paint = Transform(torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), False, gains, torch.tensor([2, 0, 1]))
    before, after = picture(scene, camera())[0], picture(paint.apply(scene), camera())[0]
    assert torch.allclose(after, (before * gains)[..., [2, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_bands_turn_as_directions_do(degree, seed):
    matrix = random_transform(torch.Generator().manual_seed(seed)).matrix
    turned = sh_matrix(matrix, degree)
    assert torch.allclose(turned @ turned.T, torch.eye(2 * degree + 1, dtype=torch.float64), atol=1e-12)
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64), dim=1)
    band = slice(degree**2, (degree + 1) ** 2)
    there = sh_basis(directions, degree)[:, band] @ turned
    assert torch.allclose(there, sh_basis(directions @ matrix, degree)[:, band], atol=1e-12)


def test_a_zero_quaternion_turns_as_the_identity_does():
    scene = a_scene(n=2)
    zero = scene.replace(quats=torch.zeros_like(scene.quats))
    one = scene.replace(quats=torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64))
    transform = random_transform(torch.Generator().manual_seed(5))
    assert torch.equal(transform.apply(zero).quats, transform.apply(one).quats)


def test_float32_and_extremes_keep_finite_values_and_gradients():
    scene = a_scene(dtype=torch.float32)
    scene = scene.replace(
        means=scene.means * torch.tensor([1e-30, 1.0, 1e30]).repeat(14)[:40, None],
        quats=scene.quats * torch.tensor([1e-15, 1.0, 1e15]).repeat(14)[:40, None],
        scales=torch.where(torch.arange(40)[:, None] % 7 == 0, -math.inf, scene.scales),
        opacities=torch.where(torch.arange(40)[:, None] % 5 == 0, math.inf, scene.opacities),
    )
    leaves = scene.map(lambda value: value.clone().requires_grad_())
    transform = random_transform(torch.Generator().manual_seed(2))
    back = transform.undo(transform.apply(leaves))
    exact = transform.undo(transform.apply(scene.to(torch.float64)))
    for (name, found), value in zip(back.items(), exact.tensors(), strict=True):
        if name in ("scales", "opacities"):
            assert torch.equal(found, getattr(scene, name))
            continue
        size = value.abs().amax(dim=1, keepdim=True)
        assert ((found.double() - value).abs() <= 3e-6 * size + 1e-37).all(), name
        found.sum().backward(retain_graph=True)
    for name in ("means", "quats", "features_dc", "features_rest"):
        assert getattr(leaves, name).grad.isfinite().all(), name
