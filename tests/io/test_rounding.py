"""Numbers rounded where the error shows least."""

import math

import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import ROUNDING, Rounding, multiples, rounded, rounding_for, steps_of, weights
from pointsplat_ns.io.formats.spz import encode_spz
from pointsplat_ns.pruning.merging.covariance import covariances, unpack
from pointsplat_ns.rasterizer import render

SILENT = lambda *told: None  # noqa: E731


def one() -> Gaussians:
    """A Gaussian twice as long as wide, at the origin."""
    return Gaussians(
        means=torch.zeros(1, 3),
        scales=torch.tensor([[0.2, 0.1, 0.1]]).log(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.zeros(1, 1),
        features_dc=torch.zeros(1, 3),
        features_rest=torch.zeros(1, 0, 3),
    )


def values(scene: Gaussians) -> torch.Tensor:
    """The Gaussian at the points of a grid, float64."""
    axis = torch.linspace(-1, 1, 61, dtype=torch.float64)
    points = torch.cartesian_prod(axis, axis, axis) - scene.means.double()
    powers = torch.einsum(
        "pi,ij,pj->p", points, unpack(covariances(scene.scales.double(), scene.quats.double()))[0].inverse(), points
    )
    return (-0.5 * powers).exp()


@pytest.mark.parametrize("psnr", [20.0, 40.0, 80.0, math.inf])
def test_the_tolerance_is_a_share_of_the_error_that_there_is(psnr):
    assert rounding_for(psnr).tolerance == pytest.approx(ROUNDING.share * 10 ** (-min(psnr, 45.0) / 20))


@pytest.mark.parametrize("step", [1e-300, 1e-9, 0.3, 7.0, 1e30])
def test_multiples_of_a_power_of_two(step):
    values = torch.tensor([0.0, 1e-20, 0.3, -7.9, 1e9], dtype=torch.float64)
    result = multiples(values, torch.tensor(step, dtype=torch.float64))
    power = 2.0 ** math.floor(math.log2(min(max(step, 2.0**-60), 2.0**60)))
    assert bool((result - values).abs().le(power / 2 + 1e-12 * values.abs()).all())
    assert torch.equal((result / power).round() * power, result)


@pytest.mark.parametrize(
    ("name", "change"), [("means", [0.0, 1.0, 0.0]), ("scales", [0.0, 1.0, 0.0]), ("quats", [0.0, 0.0, 0.0, 1.0])]
)
def test_a_step_changes_a_gaussian_by_its_tolerance_over_the_contrast(name, change):
    scene, tolerance = one(), 1e-3
    steps = {"means": "means", "scales": "log_scales", "quats": "quats"}
    error = getattr(steps_of(scene, tolerance), steps[name]) / math.sqrt(12)
    changed = scene.replace(**{name: getattr(scene, name) + error.float() * torch.tensor([change])})
    relative = float((values(changed) - values(scene)).norm() / values(scene).norm())
    assert relative == pytest.approx(tolerance / ROUNDING.contrast, rel=0.02)


def test_large_opaque_gaussians_count_more():
    scene = cloud(100)
    alone = weights(scene.replace(scales=scene.scales + torch.linspace(0, 2, 100)[:, None]))
    assert float(alone[-1] / alone[0]) > float(weights(scene)[-1] / weights(scene)[0])
    assert float(weights(scene).log().mean()) == pytest.approx(0.0, abs=1e-9)


def test_extremes_stay_finite_and_usable():
    scene = cloud(6)
    scene = scene.replace(
        scales=torch.tensor([[-80.0, 0.0, 0.0], [-80.0] * 3, [60.0, -60.0, 0.0], [0.0] * 3, [5.0] * 3, [-30.0, 9, 9]]),
        opacities=torch.tensor([[-80.0], [80.0], [0.0], [20.0], [-20.0], [5.0]]),
        means=scene.means * torch.tensor([[1e-30], [1e9], [1.0], [1e3], [0.0], [1.0]]),
        quats=torch.tensor(
            [[0.0, 0, 0, 0], [1e-30, 0, 0, 0], [1e18, 1, 0, 0], [1.0, 1, 1, 1], [1, 0, 0, 0], [0, 0, 1, 1]]
        ),
    )
    for suffix in (".spz", ".sog"):
        for tolerance in (1e-12, 0.01, 1.0, 1e6):
            small = format_to_write(suffix).rounded(scene, Rounding(tolerance))
            assert len(small) == 6 and bool(small.usable().all()), (suffix, tolerance)


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_no_tolerance_changes_nothing_and_a_small_one_little(suffix):
    scene, kind = cloud(300), format_to_write(suffix)
    assert kind.rounded(scene, Rounding(0.0)) is scene
    assert len(kind.rounded(scene[:0], Rounding(0.1))) == 0
    near = kind.rounded(scene, Rounding(1e-9))
    assert torch.allclose(near.means, scene.means, atol=1e-3)  # SOG's own steps
    assert torch.allclose(near.alphas, scene.alphas, atol=1 / 255)


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_files_become_smaller_and_keep_what_was_rounded(suffix, tmp_path):
    room, kind = ps.example_room()[::20], format_to_write(suffix)
    sizes, tolerances = [], (0.0, 0.01, 0.04)
    for tolerance in tolerances:
        small = kind.rounded(room, Rounding(tolerance))
        kind.write(small, tmp_path / f"a{suffix}", SILENT)
        kind.write(ps.load(tmp_path / f"a{suffix}"), tmp_path / f"b{suffix}", SILENT)
        first, second = ((tmp_path / f"{name}{suffix}").stat().st_size for name in "ab")
        assert second == pytest.approx(first, rel=0.01)  # written anew, nothing is rounded further
        sizes.append(first)
    assert sizes[0] > 1.1 * sizes[1] > 1.1**2 * sizes[2]


def test_a_tolerance_beats_fewer_bits_for_all(tmp_path):
    room = ps.example_room()[::4]
    views = ps.sample_views(room, 4, width=160, height=120)

    def written(data: bytes) -> tuple[int, float]:
        (tmp_path / "a.spz").write_bytes(data)
        scene = ps.load(tmp_path / "a.spz")
        return len(data), sum(float((render(scene, view) - render(room, view)).square().mean()) for view in views)

    size, error = written(encode_spz(room, sh_bits=(3, 3)))
    smaller, less = written(encode_spz(rounded(room, Rounding(0.01))))
    assert smaller < size and less < error
