"""Local units: what a network sees of a Gaussian, and how it moves it, depend on the neighbours
alone."""

import math

import torch

from making import cloud, same, small_refiner
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.refinement import refiner_preset
from pointsplat_ns.refinement.local_units import (
    FEWEST_SIZES,
    NEIGHBOURS,
    SCALES_REACH,
    local_features,
    local_units,
    moved_in_local_units,
)
from pointsplat_ns.scene.gaussians import Gaussians


def scene_to_refine(n: int = 200, dtype: torch.dtype = torch.float64) -> Gaussians:
    scene = cloud(n, sh_degree=1).to(dtype)
    return scene.replace(means=(4 * scene.means * 1024).round() / 1024)


def features_of(scene: Gaussians, kept: float = 0.1):
    return local_features(scene, local_units(scene), 15, kept, torch.float64)


def residuals_of(n: int, **given) -> dict[str, torch.Tensor]:
    sizes = {"means": 3, "scales": 3, "quats": 3, "opacities": 1, "features_dc": 3}
    zeros = {name: torch.zeros(n, size) for name, size in (sizes | {"features_rest": 45}).items()}
    return zeros | given


def covariances(scene: Gaussians) -> torch.Tensor:
    axes = rotation_matrices(scene.quats) * scene.stds[:, None]
    return axes @ axes.transpose(1, 2)


def test_the_unit_is_the_mean_distance_to_the_nearest_others():
    scene = scene_to_refine(60)
    distances = torch.cdist(scene.means, scene.means).sort(dim=1).values[:, 1 : NEIGHBOURS + 1]
    units = local_units(scene)
    assert units.near.shape == (60, NEIGHBOURS)
    # cdist multiplies matrices: its rounding is of the squares
    assert torch.allclose(units.unit, distances.mean(dim=1), rtol=1e-6)


def test_the_input_does_not_depend_on_unit_and_place():
    scene = scene_to_refine()
    far = torch.tensor([16.0, -64.0, 4.0], dtype=torch.float64)
    moved = scene.replace(means=scene.means * 8 + far, scales=scene.scales + math.log(8.0))
    for name, value in vars(features_of(scene)).items():
        # log 8 is rounded
        assert torch.allclose(value, vars(features_of(moved))[name], atol=1e-12), name


def test_the_input_away_from_a_cut_is_that_of_the_whole_scene():
    scene = scene_to_refine(400)
    of_piece = scene.means[:, 0] < scene.means[:, 0].median()
    piece = scene[of_piece]
    near = local_units(scene).near
    inside = of_piece[near].all(dim=1) & of_piece
    inside &= inside[near].all(dim=1)  # of neighbours, also their units count
    rows = inside[of_piece]
    assert 20 < int(rows.sum()) < len(piece)
    for name, value in vars(features_of(piece)).items():
        assert torch.equal(value[rows], vars(features_of(scene))[name][inside]), name


def test_the_input_is_that_of_the_ellipsoid_however_it_is_described():
    scene = scene_to_refine(50)
    turn = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)  # x to y to z to x
    w, x, y, z = scene.quats.unbind(1)
    a, b, c, d = turn
    quats = torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        dim=1,
    )
    other = scene.replace(quats=quats, scales=scene.scales[:, [1, 2, 0]])
    assert torch.allclose(covariances(scene), covariances(other))
    for name, value in vars(features_of(scene)).items():
        assert torch.allclose(value, vars(features_of(other))[name], atol=1e-9), name
    # so is what is made of it
    residuals = residuals_of(50, scales=torch.tensor([[0.5, -0.2, 0.1]]).repeat(50, 1))
    residuals["quats"] = torch.tensor([[0.2, -0.1, 0.3]]).repeat(50, 1)
    one, two = (
        moved_in_local_units(start, local_units(start), residuals) for start in (scene, other)
    )
    assert torch.allclose(covariances(one), covariances(two))


def test_a_small_rotation_is_about_the_axes_of_the_world():
    scene = scene_to_refine(20)
    angle = 1e-4
    turned = moved_in_local_units(
        scene, local_units(scene), residuals_of(20, quats=torch.tensor([[0.0, 0.0, angle]]))
    )
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    wanted = turn @ covariances(scene) @ turn.T
    assert torch.allclose(covariances(turned), wanted, atol=1e-9)  # the cube of the angle, and more


def test_residuals_are_bounded():
    scene = scene_to_refine(20)
    scene.means[3] = 1e4  # far from all others
    refiner = small_refiner(units="local", means_reach=0.25)
    with torch.no_grad():
        refiner.heads.mlps["means"][-1].bias.fill_(100.0)
        refiner.heads.mlps["scales"][-1].bias.fill_(-100.0)
    refined = refiner(scene)
    unit = torch.minimum(local_units(scene).unit, FEWEST_SIZES * scene.stds.amax(dim=1))
    assert torch.allclose(refined.means - scene.means, (0.25 * unit)[:, None].expand(-1, 3))
    assert torch.allclose(scene.scales - refined.scales, torch.tensor(SCALES_REACH).double())


def test_the_share_that_was_kept_changes_the_result():
    scene = scene_to_refine().to(torch.float32)
    refiner = small_refiner(units="local")
    assert same(refiner(scene), refiner(scene, kept=0.1))
    assert not same(refiner(scene), refiner(scene, kept=0.5))


def test_refining_a_piece_alone_changes_little_away_from_the_cut():
    """The network's patches and cells are others in a piece, so not to the bit."""
    scene = scene_to_refine(2000, torch.float32)
    refiner = small_refiner(units="local")
    x = scene.means[:, 0]
    inside = x < x.median()
    whole = refiner(scene)[inside]
    piece = refiner(scene[inside])
    deep = x[inside] < x.quantile(0.2)
    moved = (whole.opacities - scene.opacities[inside])[deep]
    assert (whole.opacities - piece.opacities)[deep].abs().mean() < 0.5 * moved.abs().mean()


def test_the_concatenating_encoder_has_all_of_the_local_features():
    refiner = small_refiner(encoder="concat", units="local")
    scene = scene_to_refine(40)
    units = local_units(scene)
    features = local_features(scene, units, refiner.config.num_rest, 0.1, torch.float64)
    expected = [features.geometry, features.appearance, features.features_rest]
    encoded = refiner.encoder(features)
    assert torch.equal(encoded, torch.cat(expected, dim=1))
    assert encoded.shape[1] == refiner.config.encoded_dim


def test_a_preset_with_local_units_normalises_each_point_by_itself():
    config = refiner_preset("tiny", units="local")
    assert (config.norm, config.means_reach) == ("layer", 0.5)
    assert refiner_preset("tiny", units="local", norm="scene").norm == "scene"
    assert refiner_preset("tiny").norm == "scene"
