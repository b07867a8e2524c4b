"""Visibility weights, and the choice of a size change by renders."""

import math
from dataclasses import replace

import pytest
import torch

from making import ball, normal_scene, photographed, splats
from pointsplat_ns.pruning.merging import MERGING, visibility
from pointsplat_ns.pruning.merging.groups import best_size_change, top_of_parabola
from pointsplat_ns.pruning.merging.state import Participants
from pointsplat_ns.pruning.merging.visibility import (
    Visibility,
    views_and_weights,
    visibility_in,
    visibility_of,
)
from pointsplat_ns.rendering.comparison.sizes import RendersOfSizes
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.poses import look_at
from pointsplat_ns.view_sampling.sampler import Sampler, sample_views
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings

pytestmark = pytest.mark.usefixtures("quick")


def of_origin(*eyes: tuple[float, float, float], width: int = 64, height: int = 48) -> Views:
    """Views of the origin."""
    at = torch.tensor(eyes).double()
    K = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]).double()
    return Views(
        look_at(at, torch.zeros_like(at)), K.repeat(len(eyes), 1, 1), width, height, torch.zeros(3)
    )


def wall(z: float, rows: int = 32, size: float = 2.0) -> Gaussians:
    """A wall of flat, opaque Gaussians that touch each other."""
    line = torch.linspace(-1, 1, rows)
    across = torch.cartesian_prod(line, line) * size / 2
    means = torch.cat([across, torch.full((len(across), 1), z)], dim=1)
    return splats(means, torch.tensor([size / rows, size / rows, 0.01]).log(), 4.0)


def weights_of(scene: Gaussians, views: Views) -> torch.Tensor:
    return visibility_in(scene, torch.arange(len(scene)), views).weights


def aside(scene: Gaussians, x: float) -> Gaussians:
    return scene.replace(means=scene.means + torch.tensor([x, 0.0, 0.0]))


def test_weights_fall_with_the_square_of_the_distance():
    near, far = weights_of(
        Gaussians.cat([aside(wall(0), -1.2), aside(wall(4), 1.2)]), of_origin((0, 0, -4))
    ).chunk(2)
    assert float(near.median() / far.median()) == pytest.approx(4, rel=0.1)


def test_weights_hardly_depend_on_the_size_of_gaussians_even_below_a_pixel():
    """Of 256 in a row, each is 0.2 pixels large. Widened by 0.3 pixels, it would weigh ten times as
    much."""
    coarse = aside(wall(0, rows=16), -1.2)
    fine = aside(wall(0, rows=256), 1.2)
    found = weights_of(Gaussians.cat([coarse, fine]), of_origin((0, 0, -4)))
    assert 0.5 < float(found[256:].median() / found[:256].median()) < 2


@pytest.mark.parametrize("max_count", [5000, 700, 3])  # of more, some are drawn for all
def test_an_occluded_gaussian_has_a_small_weight_also_where_some_are_drawn_for_all(max_count):
    scene = Gaussians.cat([wall(-0.5), wall(0.5)])  # alike to the last digit in all else
    participants = Participants.of(scene, torch.arange(len(scene)))
    _, (found, _) = views_and_weights(
        participants, of_origin((0, 0, -4)), replace(MERGING, max_count_drawn=max_count)
    )
    assert found.shape == (len(scene),) and found.dtype == torch.float32
    front = scene.means[participants.members, 2] < 0
    if max_count > 3:
        times = 10 if max_count == 5000 else 1.5
        assert float(found[front].median()) > times * float(found[~front].median())


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("case", ["normal", "wild scales", "transparent", "no view"])
def test_weights_are_bounded_whatever_the_scene(dtype, case):
    scene = Gaussians(*(value.to(dtype) for value in normal_scene(400, degree=0).tensors()))
    if case == "wild scales":
        wild = scene.scales.clone()
        wild[:100] = -math.inf
        wild[100:200, 0] = math.inf
        wild[200:300] = torch.finfo(dtype).max
        scene = scene.replace(scales=wild)
    if case == "transparent":
        scene = scene.replace(opacities=torch.full_like(scene.opacities, -math.inf))
    views = of_origin((0, -6, 1))[[]] if case == "no view" else of_origin((0, -6, 1))
    found = weights_of(scene, views)
    least = MERGING.min_visibility
    assert found.shape == (400,) and bool(
        ((found >= 0.999 * least) & (found <= 1.001 / least)).all()
    )
    if case in ("transparent", "no view"):  # nothing is known
        assert found.tolist() == [1.0] * 400


def test_traces_count_where_sh_tell_of_photos_and_fog_has_no_views(monkeypatch):
    monkeypatch.setattr(
        visibility,
        "visibility_in",
        lambda scene, rows, *_: Visibility(torch.full((len(rows),), 0.5)),
    )
    monkeypatch.setattr(
        visibility, "trace_factors", lambda scene, members: torch.full((len(members),), 16.0)
    )
    # Without SH, all are sure.
    all_sure = replace(DEFAULT_SETTINGS, min_size_evidence=-1.0)
    settings = replace(MERGING, sampled_views=2, min_count_rendered=0)
    fog = ball(200).replace(opacities=torch.full((200, 1), -math.inf))
    for scene, weight in ((photographed(), 8.0), (ball(500, 0), 0.5), (fog, 1.0)):
        participants = Participants.of(scene, torch.arange(len(scene)))
        with use_settings(all_sure):
            views, (weights, _) = views_and_weights(
                participants, Sampler(scene, (32, 24)), settings
            )
        assert weights.tolist() == [weight] * len(scene) and (views is None) == (scene is fog)


def blurs_of(scene: Gaussians, views: Views, **changes: float) -> torch.Tensor | None:
    """Blurs of all Gaussians, in the order of the scene, squared scene units."""
    participants = Participants.of(scene, torch.arange(len(scene)))
    found = visibility_of(participants, views, replace(MERGING, **changes)).blurs
    if found is None:
        return None
    return found[participants.members.argsort()] * participants.size**2


def test_blurs_are_the_variance_of_the_rasterizer_at_the_depth_of_each():
    """0.3 pixels^2 times (z / f)^2; images up to 320 pixels are not subsampled, larger ones are."""
    scene = Gaussians.cat([aside(wall(0, size=0.9), -0.6), aside(wall(4, size=0.9), 0.6)])
    near, far = (0.3 * (depth / 64) ** 2 for depth in (4, 8))
    for width, f in ((64, 64), (1920, 784)):
        found = blurs_of(scene, of_origin((0, 0, -4), width=width, height=width * 3 // 4))
        expected = torch.tensor([near, far]).repeat_interleave(1024) * (64 / f) ** 2
        torch.testing.assert_close(found, expected, rtol=2e-3, atol=0)  # 784 x 588 is rounded


def test_blurs_are_the_mean_over_the_pixels_of_views_and_the_median_where_none_is():
    hidden = aside(wall(0, rows=8), 100.0)
    scene = Gaussians.cat([wall(0), hidden])
    views = of_origin((0, 0, -4), (0, 0, -8))
    found = blurs_of(scene, views)
    wall_pixels = 4.0  # the wall is four times as many pixels from half the distance
    expected = 0.3 / 64**2 * (wall_pixels * 4**2 + 8**2) / (wall_pixels + 1)
    assert float(found[:1024].median()) == pytest.approx(expected, rel=0.03)
    assert bool((found[1024:] == found[:1024].sort().values[511]).all())


def test_no_blur_is_added_to_antialiased_scenes_or_if_it_is_turned_off():
    views = of_origin((0, 0, -4))
    scene = wall(0, rows=8)
    assert blurs_of(scene, views) is not None
    assert blurs_of(scene.replace(antialiased=True), views) is None
    assert blurs_of(scene, replace(views, rasterize_mode="antialiased")) is None
    assert blurs_of(scene, views, blur=0.0) is None
    torch.testing.assert_close(blurs_of(scene, views, blur=0.5), 0.5 * blurs_of(scene, views))


@pytest.mark.parametrize("distance", [1e-3, 1e3, 1e12, 1e30])
def test_blurs_are_at_most_the_size_of_the_content(distance):
    """From 1e3 on, a pixel is larger than the scene."""
    scene = wall(0, rows=8)
    participants = Participants.of(scene, torch.arange(len(scene)))
    found = visibility_of(participants, of_origin((0, 0, -distance)), MERGING).blurs
    assert bool((found <= 1).all()) and bool((found >= 0).all())


@pytest.mark.parametrize(
    ("at", "values", "margin", "want"),
    [
        pytest.param(
            (-1.0, 0.0, 2.0), [-((x - 0.7) ** 2) for x in (-1, 0, 2)], 0.0, 0.7, id="a top inside"
        ),
        pytest.param(
            (0.0, 1.0, 2.0), [-((x - 9.0) ** 2) for x in range(3)], 0.5, 2.5, id="a top above"
        ),
        pytest.param((0.0, 1.0, 2.0), [1.0, 1.0, 1.0], 0.5, 0.0, id="level"),
        pytest.param(
            (0.0, 1.0, 2.0), [1.0, 0.0, 2.0], 0.5, 2.0, id="a valley, the right side higher"
        ),
        # A flower scene gained 1.3 dB at each step, more at each, and stopped 0.8 dB short of what
        # it could have.
        pytest.param((0.0, 1.0, 2.0), [0.0, 1.0, 2.0], 0.5, 2.5, id="rising evenly"),
    ],
)
def test_the_top_of_a_parabola_within_margins_or_else_the_best_trial(at, values, margin, want):
    assert top_of_parabola(at, values, margin) == pytest.approx(want)


@pytest.mark.parametrize("change", [-0.08, 0.03])
def test_the_size_change_that_undoes_a_known_one_is_found(change):
    dense = ball(500)
    views = sample_views(dense, 3, width=96, height=72)
    reference = RendersOfSizes(dense, [views])

    def psnr_of(trial: float) -> float:
        return reference.psnr(dense.replace(scales=dense.scales + trial - change))

    found = best_size_change(psnr_of)
    assert psnr_of(found) >= psnr_of(0.0) and found == pytest.approx(change, abs=0.03)
