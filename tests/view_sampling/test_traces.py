"""Traces of photos, and where views come from."""

import math

import pytest
import torch

from making import EYES, ball, normal_scene, photographed, run_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.pipeline.view_provider import Origin, ViewOrigin, ViewProvider
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.view_sampling.sampler import sample_views
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS
from pointsplat_ns.view_sampling.traces import (
    PhotoTraces,
    correlations,
    explained_energy,
    mean_explained,
    trace_factors,
    unit_sh,
)


def test_places_of_photos_are_found():
    found = PhotoTraces(photographed())
    places = found.places
    shares = found.shares
    assert found.sure
    away = torch.cdist(places, EYES.double()).min(1).values
    assert float(shares.sum()) == pytest.approx(1) and bool((shares > 0).all())
    assert float((shares * away).sum()) < 1.0
    opposite = torch.cdist(places, -EYES.double()).min(1).values
    assert float((shares * opposite).sum()) > 4.0


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_correlation_is_that_of_float64_at_any_size(size):
    generator = torch.manual_seed(4)
    a, b = torch.randn(2, 500, generator=generator, dtype=torch.float64)
    b = b + a
    expected = float(torch.corrcoef(torch.stack([a, b]))[0, 1])
    rows = torch.stack([size * a, torch.full_like(a, size), torch.zeros_like(a)])
    found, equal, zero = correlations(rows, b).tolist()
    assert found == pytest.approx(expected, abs=1e-12)
    assert equal == pytest.approx(0, abs=1e-6) and zero == 0
    assert correlations(rows, torch.ones_like(b)).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 8, 21])  # less than, exactly and more than a vector of 8
def test_evidence_of_kernels_is_that_of_torch(degree, count):
    scene = ball(count, degree)
    sh = unit_sh(scene.features_rest)
    generator = torch.Generator().manual_seed(degree)
    places = 3 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    ours, torchs = (mean_explained(scene.means.double(), sh, places, to) for to in (None, False))
    torch.testing.assert_close(ours, torchs, rtol=1e-5, atol=1e-6)  # float32


def test_random_sh_are_explained_once_on_average():
    scene = ball(4000, 3)
    found = explained_energy(scene.means.double(), unit_sh(scene.features_rest))
    assert float(found.mean()) == pytest.approx(1, abs=0.1)  # of random directions


@pytest.mark.parametrize(
    "scene",
    [
        normal_scene(3000),
        ball(501, 0).replace(
            scales=torch.tensor([[-1.0] * 3, [-math.inf, -1.0, -1.0], [-math.inf] * 3]).repeat(
                167, 1
            )
        ),
        ball(500, 0).replace(scales=torch.full((500, 3), -math.inf)),
        ball(500, 0).replace(means=torch.zeros(500, 3)),
        ball(500).replace(features_rest=torch.zeros(500, 3, 3)),
        photographed().replace(opacities=torch.full((600, 1), -math.inf)),
        photographed().replace(features_rest=torch.full((600, 15, 3), math.nan)),
    ],
    ids=["random", "flat", "points", "at one position", "zero", "invisible", "NaN"],
)
def test_no_place_is_sure_in_scenes_without_evidence_and_none_is_infinite(scene):
    found = PhotoTraces(scene)
    assert (
        not found.sure
        and bool(found.shares.isfinite().all())
        and bool(found.places.isfinite().all())
    )


@pytest.mark.parametrize("factor", [1e-30, 1e38])
def test_photo_places_are_found_from_sh_of_any_length_but_zero(factor):
    scene = photographed()
    large = scene.replace(
        features_rest=(scene.features_rest.double() * factor).clamp(-3e38, 3e38).float()
    )
    found = PhotoTraces(large)
    assert found.sure == (factor != 1e-30)
    assert bool(found.places.isfinite().all()) and float(found.shares.sum()) == pytest.approx(1)


def halves(factor: float = 10.0) -> Gaussians:
    """Two clusters far apart, the first with ``factor`` times the SH of the second."""
    scene = ball(2000, 1)
    first = torch.arange(2000) < 1000
    means = scene.means + torch.where(first, 0.0, 100.0)[:, None]
    rest = scene.features_rest * torch.where(first, factor, 1.0)[:, None, None]
    return scene.replace(means=means, features_rest=rest, scales=torch.full((2000, 3), -2.0))


def flattened(scene: Gaussians) -> Gaussians:
    """A scene whose first 1,000 Gaussians are a third as thick."""
    scales = scene.scales.clone()
    scales[:1000, 1] -= math.log(3)
    return scene.replace(scales=scales)


@pytest.mark.parametrize(
    ("scene", "ratio", "within"), [(halves(2.0), 2**1.5, 0.05), (flattened(halves(1.0)), 3, 0.1)]
)
def test_trace_factors_grow_with_sh_energy_to_the_power_of_three_quarters_and_with_flatness(
    scene, ratio, within
):
    factors = trace_factors(scene, torch.arange(2000))
    # within: the SH of both halves are random
    apart = factors[:900].double().log().mean() - factors[1100:].double().log().mean()
    assert float(apart.exp()) == pytest.approx(ratio, rel=within)
    assert factors.dtype == torch.float32 and float(factors.log().median().abs()) < 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extremes_stay_within_bounds(dtype):
    scene = Gaussians(*(value.to(dtype) for value in halves(0.0).tensors()))
    largest = torch.finfo(dtype).max
    for size in (0.0, torch.finfo(dtype).tiny, largest):
        rest = scene.features_rest.clone()
        rest[1000:] = size
        scales = scene.scales.clone()
        scales[:500] = -math.inf
        scales[500:800, 0] = -math.inf
        scales[800:900, 2] = 0.5 * largest
        factors = trace_factors(
            scene.replace(features_rest=rest, scales=scales), torch.arange(2000)
        )
        assert bool(factors.isfinite().all())
        assert float(factors.log().abs().max()) <= DEFAULT_SETTINGS.max_log_factor + 1e-5


def test_views_are_sampled_where_photos_were_taken():
    """A smooth shell around photos that were all taken from about one place."""
    eye = torch.tensor([0.6, 0.0, 0.0])
    shape = {"opacities": torch.full((3000, 1), 5.0)}
    scene, shell = (
        some.replace(**shape) for some in (photographed(3000, eyes=eye[None]), ball(3000, 3))
    )
    assert PhotoTraces(scene).sure
    away = []
    for views in (sample_views(scene, 4, 64, 48), sample_views(shell, 4, 64, 48)):
        away.append(
            float((invert_rigid(views.viewmats)[:, :3, 3] - eye.double()).norm(dim=1).mean())
        )
    assert away[0] < 0.5 and away[0] < 0.5 * away[1]


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return ball(400)


def test_given_views_go_before_a_datasets_and_those_before_sampled_ones(scene, trained_walls):
    run = run_of(trained_walls, "wall-b")
    given = sample_views(scene, 3, 48, 36)
    of_run = ViewProvider(scene, run=run)
    known = of_run.known(4)
    views = of_run.views(4)
    assert len(known) == len(views) == 4 and of_run.origin == ViewOrigin(Origin.DATASET)
    assert (views.width, views.height, views.rasterize_mode) == (64, 48, "antialiased")
    assert views.background.tolist() == [1.0, 1.0, 1.0]
    source = ViewProvider(scene, given, run)
    assert (
        source.views(9) is given
        and len(source.known(2)) == 2
        and source.origin == ViewOrigin(Origin.GIVEN)
    )
    gone = ViewProvider(scene, run=run, data="nowhere")
    assert len(gone.views(2)) == 2
    assert gone.origin is not None
    assert (gone.origin.kind, gone.origin.up) == (Origin.SAMPLED, gone.sampler.up)
    assert "nowhere" in gone.origin.missing
    assert ViewProvider(scene, run="scene.ply").known(4) is None
    assert ViewProvider(scene, given=given[:0]).known(3) is None
    with pytest.raises(DataError, match="the views given are empty"):
        ViewProvider(scene, given[:0]).views(3)


def test_a_resolution_is_that_of_sampled_views_and_bounds_given_ones(scene):
    asked = ViewProvider(scene, resolution=(96, 54)).views(2)
    assert (asked.width, asked.height) == (96, 54)
    given = sample_views(scene, 2, 90, 60)
    assert ViewProvider(scene, given=given, resolution=(30, 20)).views(2).width == 30
    assert next(ViewProvider(scene, given=given, resolution=(30, 20)).others()).width == 30


def test_a_scene_without_known_views_is_repaired_on_two_backgrounds(scene):
    views = ViewProvider(scene, resolution=(64, 48)).others()
    behind = [next(views).background.tolist() for _ in range(10)]
    assert behind.count([1.0, 1.0, 1.0]) == 2 and behind.count([0.0, 0.0, 0.0]) == 8
