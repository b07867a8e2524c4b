import pytest
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.normalize import canonical_quats, gaussian_features, unit_cube


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


def test_a_minority_of_floaters_is_clamped_to_the_faces():
    means = cloud(1000)
    means[:8] = 50 + cloud(8, seed=1)
    assert unit_cube(means).extent <= 2.0
    assert (unit_cube(means).positions(means)[:8] == 0.5).all()


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


def test_a_quaternion_and_its_negative_have_one_canonical_form():
    q = torch.randn(100, 4, generator=torch.Generator().manual_seed(0))
    q[0], q[1], q[2] = torch.tensor([[0.0, -1, 2, 3], [0, 0, 0, -2], [-0.0, 0, -1, 1]])
    (a, s), (b, t) = canonical_quats(q), canonical_quats(-q)
    assert torch.equal(a, b) and torch.equal(s, -t)
    assert (a[:, 0] >= 0).all() and a[1, 3] == 1


def test_the_zero_quaternion_is_the_identity_with_a_finite_gradient():
    q = torch.zeros(2, 4, requires_grad=True)
    unit, scale = canonical_quats(q)
    assert unit.tolist() == [[1, 0, 0, 0]] * 2 and scale.tolist() == [[1], [1]]
    (unit.sum() + scale.sum()).backward()
    assert q.grad.isfinite().all()


def test_quaternion_gradients_in_float32_equal_float64():
    q64 = torch.randn(50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    grads = []
    for q in (q64.clone(), q64.float()):
        q.requires_grad_()
        unit, scale = canonical_quats(q)
        (unit[:, 1] * 3 + unit[:, 3] + scale[:, 0]).sum().backward()
        grads.append(q.grad.double())
    assert torch.allclose(*grads, rtol=1e-4, atol=1e-5)  # cancellation against lengths down to 0.3


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
