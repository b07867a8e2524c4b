"""Visibility weights: distance, pictures, occlusion, and how they are combined."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from making import ball, cloud, normal_scene, photographed
from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.looking.content import content_size, in_units, views_in_units
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.pruning.merging import DEFAULTS, merge, weights
from pointsplat_ns.pruning.merging.participants import Participants
from pointsplat_ns.pruning.merging.regrouping import masses_of, moments
from pointsplat_ns.pruning.merging.viewpoints import Viewpoints, in_picture, sampled_viewpoints, view_weights
from pointsplat_ns.pruning.merging.visibility import PixelCounts, count_pixels
from pointsplat_ns.pruning.merging.weights import visibility_weights
from pointsplat_ns.views import Views

LEAST_NEAR, LEAST_SINGLE = (
    least**DEFAULTS.occlusion_exponent for least in (DEFAULTS.min_share_neighbours, DEFAULTS.min_share_single)
)


def along_z(*eyes: tuple[float, float, float]) -> Views:
    """Views of 16 pixels and a focal length of 10 from some places, along z."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(eyes), 1, 1)
    viewmats[:, :3, 3] = -torch.tensor(eyes, dtype=torch.float64)
    K = torch.tensor([[10.0, 0, 8], [0, 10.0, 8], [0, 0, 1.0]]).repeat(len(eyes), 1, 1)
    return Views(viewmats, K, 16, 16, torch.zeros(3))


def of_origin(*eyes: tuple[float, float, float], width: int = 64, height: int = 48) -> Views:
    """Views of the origin."""
    at = torch.tensor(eyes).double()
    K = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]).double()
    return Views(look_at(at, torch.zeros_like(at)), K.repeat(len(eyes), 1, 1), width, height, torch.zeros(3))


def weights_of(means: list[list[float]], views: Views, outside_weight: float = 1.0) -> list[float]:
    found = view_weights(torch.tensor(means, dtype=torch.float64), views, outside_weight, DEFAULTS)
    assert found.dtype == torch.float32
    return found.tolist()


def test_weights_fall_with_the_square_of_the_distance():
    near, far = weights_of([[0.0, 0, 50.0], [0.0, 0, 100.0]], along_z((0, 0, 0)))
    assert near / far == pytest.approx(4, rel=0.01)  # the smallest distance adds in quadrature


def test_weights_are_means_over_views_and_finite_at_the_camera_and_at_the_end_of_the_range():
    (one,), (two,) = (
        weights_of([[0.0] * 3], along_z((0, 0, 0))),
        weights_of([[0.0] * 3], along_z((0, 0, 0), (1e9, 0, 0))),
    )
    assert 0 < one < math.inf and two == pytest.approx(0.5 * one)
    assert weights_of([[1e300] * 3], along_z((0, 0, 0))) == [0.0]


@pytest.mark.parametrize("outside", [1.0, 1e-5])
def test_a_gaussian_outside_of_a_picture_has_a_smaller_weight(outside):
    ahead, behind = weights_of([[0.0, 0, 50.0], [0.0, 0, -50.0]], along_z((0, 0, 0), (0, 1, 0)), outside)
    assert behind == pytest.approx(outside * ahead, rel=1e-3)


def test_a_picture_holds_positions_in_front_and_inside_of_its_edges():
    """Focal length 10 and 16 pixels: the edge is at 0.8 of the depth."""
    edge = 0.8 * (1 + 2 * DEFAULTS.picture_margin)
    x = torch.tensor([0.0, 0.0, 0.0, 0.99 * edge, 1.01 * edge, -0.99 * edge, -1.01 * edge, 0.0], dtype=torch.float64)
    z = torch.tensor([1.0, -1.0, 0.0, 1, 1, 1, 1, 1e300], dtype=torch.float64)
    for places in (torch.stack([x, 0 * x, z], 1), torch.stack([0 * x, x, z], 1)):
        found = in_picture(places, along_z((0, 0, 0))[0])
        assert found.tolist() == [True, False, False, True, False, True, False, True]


def test_without_a_free_place_there_are_no_viewpoints():
    fog = ball(200)
    fog = fog.replace(opacities=torch.full((200, 1), -math.inf))
    assert sampled_viewpoints(fog, 32, 24, DEFAULTS) is None


def test_photo_places_are_found_unless_that_is_turned_off():
    content = photographed()
    content = in_units(content, *content_size(content))
    settings = replace(DEFAULTS, sampled_views=2)
    assert sampled_viewpoints(content, 32, 24, settings).photos is not None
    assert sampled_viewpoints(content, 32, 24, replace(settings, find_photo_places=False)).photos is None


def two_walls(rows: int = 32) -> Gaussians:
    """Two walls of flat, opaque Gaussians, one behind the other, alike to the last digit in all else."""
    line = torch.linspace(-1, 1, rows)
    across = torch.cartesian_prod(line, line)
    means = torch.cat([torch.cat([across, torch.full((len(across), 1), z)], dim=1) for z in (-0.5, 0.5)])
    scene = ball(len(means), 0)
    scales = torch.tensor([2 / rows, 2 / rows, 0.01]).log().expand(len(means), 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4)
    return scene.replace(means=means, scales=scales, quats=quats, opacities=torch.full((len(means), 1), 4.0))


def counted(scene: Gaussians, views: Views, weights: torch.Tensor | None = None) -> PixelCounts:
    """Pixels of all Gaussians of a scene."""
    weights = torch.ones(len(scene)) if weights is None else weights
    return count_pixels(scene, torch.arange(len(scene)), weights, views, DEFAULTS)


def test_an_occluded_gaussian_has_a_small_share():
    counts = counted(two_walls(), of_origin((0, 0, -4)))
    for shares, least in (
        (counts.neighbourhood_shares(DEFAULTS), LEAST_NEAR),
        (counts.single_shares(DEFAULTS), LEAST_SINGLE),
    ):
        front, back = shares.chunk(2)
        assert shares.dtype == torch.float32
        assert float(front.median()) > 0.9 and float(back.median()) < max(0.15, least * 1.001)


def test_merging_keeps_visible_gaussians_rather_than_occluded_ones():
    kept = merge(two_walls(), 600, views=of_origin((0, 0, -4), (1, 0, -4), (0, 1, -4))).scene
    front = int((kept.means[:, 2] < 0).sum())
    assert len(kept) == 600 and front > 1.5 * (600 - front)


def test_in_a_large_scene_some_gaussians_are_drawn_for_all():
    scene = two_walls()
    participants = Participants.of(scene, torch.arange(len(scene)))
    views = views_in_units(of_origin((0, 0, -4)), participants.centre, participants.size)
    viewpoints = Viewpoints(views, given=True)
    found = visibility_weights(participants, viewpoints, replace(DEFAULTS, occlusion_max_count=700)).visibility
    front = scene.means[participants.members, 2] < 0
    assert float(found[front].mean()) > 1.5 * float(found[~front].mean())


def test_a_group_has_the_colour_of_its_visible_members():
    scene = two_walls()
    front, back = scene.features_dc.chunk(2)
    scene = scene.replace(features_dc=torch.cat([torch.ones_like(front), -torch.ones_like(back)]))
    members, group = torch.arange(len(scene)), torch.arange(len(scene)) % len(front)  # each with the one behind it
    masses = masses_of(scene, members)
    visibility = counted(scene, of_origin((0, 0, -4))).single_shares(DEFAULTS)
    for factor, redness in ((torch.ones(len(scene)), 0.0), (visibility, (1 - 0.4) / (1 + 0.4))):
        colours = moments(scene, members, masses * factor, group, len(front)).colours
        assert float(colours.median()) / SH_C0 == pytest.approx(redness, abs=0.06)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("case", ["normal", "wild scales", "transparent", "no view"])
def test_shares_are_bounded_whatever_the_scene(dtype, case):
    scene = Gaussians(*(value.to(dtype) for value in normal_scene(400, degree=0).tensors()))
    if case == "wild scales":
        wild = scene.scales.clone()
        wild[:100], wild[100:200, 0], wild[200:300] = -math.inf, math.inf, torch.finfo(dtype).max
        scene = scene.replace(scales=wild)
    if case == "transparent":
        scene = scene.replace(opacities=torch.full_like(scene.opacities, -math.inf))
    views = of_origin((0, -6, 1))[[]] if case == "no view" else of_origin((0, -6, 1))
    for weight in (1.0, 0.0, 3e38):
        counts = counted(scene, views, torch.full((400,), weight))
        near, single = counts.neighbourhood_shares(DEFAULTS), counts.single_shares(DEFAULTS)
        assert near.shape == single.shape == (400,)
        assert bool(((near >= LEAST_NEAR * 0.999) & (near <= 1)).all())
        assert bool(((single >= LEAST_SINGLE * 0.999) & (single <= 1)).all())
        if case == "no view":  # nothing is known, so nothing is occluded
            assert near.tolist() == single.tolist() == [1.0] * 400


@pytest.mark.parametrize("max_count", [30, 29, 7, 1])  # of more, some are drawn
@pytest.mark.parametrize(
    ("where", "factor"), [("given", 4.0), ("photos", 16.0), ("room", 2.0), ("object", 1.0)]
)  # 16^(1/2), 16, 16^(1/4), 16^0
def test_weights_are_products_of_area_visibility_and_traces(monkeypatch, where, factor, max_count):
    class Fixed(PixelCounts):
        """A fifth of the neighbourhoods is visible, and half of each Gaussian."""

        def neighbourhood_shares(self, settings):
            return torch.full((len(self.covered),), 0.2)

        def single_shares(self, settings):
            return torch.full((len(self.covered),), 0.5)

    def counts(scene, members, area, views, settings):
        assert len(members) == len(area) <= max_count
        return Fixed(area, area)

    monkeypatch.setattr(weights, "count_pixels", counts)
    monkeypatch.setattr(weights, "is_room", lambda scene: where == "room")
    for name, value in (("view_weights", 3.0), ("place_weights", 3.0), ("how_much_seen", 16.0)):
        monkeypatch.setattr(weights, name, lambda *_, value=value: torch.full((30,), value))
    photos = (torch.zeros(1, 3), torch.ones(1)) if where == "photos" else None
    viewpoints = Viewpoints(of_origin((0, -6, 1)), given=where == "given", photos=photos)
    participants = Participants.of(cloud(30), torch.arange(30))
    found = visibility_weights(participants, viewpoints, replace(DEFAULTS, occlusion_max_count=max_count))
    assert found.visibility.tolist() == [0.5] * 30
    assert found.area.tolist() == pytest.approx([3.0 * 0.2 * factor] * 30)


def test_without_viewpoints_all_weights_are_equal():
    found = visibility_weights(Participants.of(cloud(30), torch.arange(30)), None, DEFAULTS)
    assert found.area.tolist() == found.visibility.tolist() == [1.0] * 30
