"""What a network is given."""

import math

import pytest
import torch
from safetensors.torch import save_file

from making import normal_scene
from pointsplat_ns.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.geometry.harmonics import sh_matrix
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis
from pointsplat_ns.refiner.augmentation import Transform, random_transform
from pointsplat_ns.refiner.feedback import (
    FEEDBACK_FORMAT,
    FeedbackRefiner,
    read_feedback_refiner,
    save_feedback_refiner,
)
from pointsplat_ns.refiner.refiner import canonical_quats, gaussian_features
from pointsplat_ns.refiner.structure import unit_cube
from pointsplat_ns.refiner.weights import WeightsError


def cloud(n: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))


def test_the_cube_keeps_the_aspect_and_centres_the_scene():
    means = cloud(1000) * torch.tensor([6.0, 4.0, 2.0]) + torch.tensor([10.0, -3.0, 1.0])
    cube = unit_cube(means)
    position = cube.positions(means)
    span = position.amax(0) - position.amin(0)
    size = means.amax(0) - means.amin(0)
    assert torch.allclose(cube.extent, size.max().double())
    assert torch.allclose(span, (size / size.max()).double())
    assert torch.allclose(position.amax(0), -position.amin(0))


def test_one_far_outlier_at_most_doubles_the_extent():
    means = cloud(1000)
    plain = unit_cube(means).extent
    means[0] = 1e6
    cube = unit_cube(means)
    assert cube.extent <= 2.0 * plain
    position = cube.positions(means)
    assert position.abs().max() <= 0.5
    assert (position[1:].amax(0) - position[1:].amin(0)).min() > 0.3


@pytest.mark.parametrize(
    "means",
    [
        torch.zeros(1, 3),
        torch.ones(5, 3) * 1e6,
        torch.tensor([[0.0, 0, 0], [1e-30, 0, 0]]),
        torch.tensor([[-3e38, 0, 0], [3e38, 0, 0]]),
        torch.tensor([[0.0, 0, 0]] * 20 + [[7.0, 0, 0]]),
    ],
    ids=["one", "coincident", "tiny", "huge", "one-apart"],
)
def test_degenerate_extents_give_finite_positions_within_the_cube(means):
    cube = unit_cube(means)
    assert cube.extent > 0 and cube.extent.isfinite()
    position = cube.positions(means)
    assert position.isfinite().all() and position.abs().max() <= 0.5


@pytest.mark.parametrize("length", [1e-35, 1e-20, 1.0, 1e20, 1e38])
def test_quaternions_of_any_length_become_unit_and_are_recovered(length):
    q = torch.randn(100, 4, generator=torch.Generator().manual_seed(0)).clamp(-1.6, 1.6) * length
    unit, scale = canonical_quats(q)
    # A few float32 roundings; those of the smallest components of the shortest are subnormal, multiples of 1.4e-45.
    assert torch.allclose(unit.norm(dim=1), torch.ones(100), atol=5e-7)
    assert torch.allclose(unit * scale, q, rtol=5e-7, atol=1e-44)


def test_features_of_extreme_parameters_are_finite_and_of_order_one():
    n = 6
    inf = torch.inf
    scene = Gaussians(
        means=torch.tensor([[0.0, 0, 0], [1, 1, 1], [1e6, 0, 0], [0, -1e6, 0], [2, 2, 2], [3, 3, 3]]),
        scales=torch.tensor([80.0, -80, -inf, 0, -5, 88])[:, None].expand(n, 3).clone(),
        quats=torch.tensor([[0.0, 0, 0, 0], [1e30, 0, 0, 0], [1e-30, 0, 0, -1e-30], [1, 1, 1, 1]] * 2)[:n],
        opacities=torch.tensor([inf, -inf, 40, -40, 0, 1])[:, None],
        features_dc=torch.full((n, 3), 1e30),
        features_rest=torch.full((n, 3, 3), -1e30),
    )
    scene = scene.map(lambda value: value.clone().requires_grad_())
    features = gaussian_features(scene, unit_cube(scene.means), num_rest=15, dtype=torch.float32)
    total = 0
    for name in ("positions", "quats", "scales", "opacities", "features_dc", "features_rest"):
        value = getattr(features, name)
        assert value.isfinite().all() and value.abs().max() <= 8, name
        total = total + value.sum()
    assert features.features_rest.shape == (n, 45)
    assert (features.features_rest[:, 9:] == 0).all()
    total.backward()
    for name, value in scene.items():
        assert value.grad.isfinite().all(), name


def trained() -> FeedbackRefiner:
    torch.manual_seed(0)
    network = FeedbackRefiner()
    for value in network.parameters():
        torch.nn.init.normal_(value)
    return network


def test_factors_are_bounded_whatever_comes_in():
    factors = trained()(100 * torch.randn(50, FeedbackRefiner.FEATURES))
    assert factors.shape == (50, len(PARAMETERS))
    assert float(factors.log().abs().max()) <= FeedbackRefiner.MAX_LOG_FACTOR + 1e-5
    assert float(factors.log().abs().max()) > 0.5 * FeedbackRefiner.MAX_LOG_FACTOR, "weights of this size use the range"


def test_a_file_gives_back_the_network(tmp_path):
    network, features = trained(), torch.randn(7, FeedbackRefiner.FEATURES)
    save_feedback_refiner(network, tmp_path / "a.safetensors", {"steps": 3})
    again = read_feedback_refiner(tmp_path / "a.safetensors")
    assert not again.training and not any(value.requires_grad for value in again.parameters())
    for found, expected in zip(again(features), network(features), strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize(
    ("bias", "form", "message"),
    [
        (torch.zeros(0), "another", "not a feedback refiner"),
        (None, FEEDBACK_FORMAT, "expected"),
        (torch.nan, FEEDBACK_FORMAT, "NaN or Inf"),
    ],
    ids=["format", "missing", "nan"],
)
def test_a_file_of_another_kind_is_refused(tmp_path, bias, form, message):
    state = trained().state_dict()
    if bias is None:
        del state["mlp.0.bias"]
    else:
        state["mlp.0.bias"] = bias if isinstance(bias, torch.Tensor) else torch.full_like(state["mlp.0.bias"], bias)
    save_file(state, tmp_path / "a.safetensors", metadata={"format": form})
    with pytest.raises(WeightsError, match=message):
        read_feedback_refiner(tmp_path / "a.safetensors")


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
