"""Random transforms of training scenes, and their inverses."""

import math

import pytest
import torch

from making import normal_scene
from pointsplat_ns.refinement.augmentation import Transform, random_transform
from pointsplat_ns.rendering import rasterization


def a_scene(n=40, sh_degree=3, dtype=torch.float64, seed=0):
    scene = normal_scene(n, sh_degree, seed, dtype)
    return scene.replace(
        scales=0.5 * scene.scales - 2,
        features_dc=0.3 * scene.features_dc,
        features_rest=0.1 * scene.features_rest,
    )


def picture(scene, viewmat):
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 24], [0, 0, 1]], dtype=scene.dtype)
    image, alpha, _ = rasterization(
        scene.means,
        scene.quats,
        scene.stds,
        scene.alphas,
        scene.sh,
        viewmat[None],
        K[None],
        48,
        48,
        sh_degree=scene.sh_degree,
    )
    return image[0], alpha[0]


@pytest.mark.parametrize(("seed", "sh_degree"), [(0, 0), (1, 1), (2, 2), (3, 3), (4, 3)])
def test_undo_gives_the_scene_back(seed, sh_degree):
    scene = a_scene(sh_degree=sh_degree, seed=seed)
    transform = random_transform(torch.Generator().manual_seed(seed))
    back = transform.undo(transform.apply(scene))
    for (name, value), found in zip(scene.items(), back.tensors(), strict=True):
        assert torch.allclose(found, value, atol=1e-12), name


def test_a_turned_scene_looks_the_same_to_a_turned_camera():
    scene = a_scene()
    drawn = random_transform(torch.Generator().manual_seed(0))
    turn = Transform(drawn.quat, False, torch.ones(3, dtype=torch.float64), torch.arange(3))
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 6.0
    turned = viewmat.clone()
    turned[:3, :3] = viewmat[:3, :3] @ turn.matrix.T
    before = picture(scene, viewmat)
    after = picture(turn.apply(scene), turned)
    for a, b in zip(before, after, strict=True):
        # A pixel at a threshold of alpha may fall on the other side of it by rounding: 1/255 of it
        # then shows.
        assert (a - b).abs().max() < 5e-3
        assert (a - b).abs().mean() < 1e-5


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
