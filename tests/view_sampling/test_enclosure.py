"""Which places are beyond the walls of a closed room."""

import math

import pytest
import torch
from upright_scenes import room, tower

import pointsplat_ns as ps
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.view_sampling.enclosure import enclosures, outside_of_a_room
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.settings import ViewSamplingSettings, use_settings


def sphere(count: int = 4000) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).double()
    return points / points.norm(dim=1, keepdim=True)


@pytest.mark.parametrize(
    "eye, low, high",
    [
        ((0.0, 0.0, 0.0), 1.0, 1.0),
        ((0.0, 0.9, 0.0), 0.85, 1.0),
        ((0.0, 0.0, 1.01), 0.3, 0.5),  # a tangent plane halves the directions
        ((0.0, 0.0, 2.0), 0.04, 0.2),  # a cap of 30 degrees is 7 % of the sphere
        ((1e6, 0.0, 0.0), 1 / 96, 4 / 96),
    ],
)
def test_a_sphere_encloses_by_the_share_of_directions_that_it_covers(eye, low, high):
    [found] = enclosures(sphere(), torch.tensor([eye])).tolist()
    assert low <= found <= high


@pytest.mark.parametrize("length", [1e-30, 1.0, 1e30])
def test_an_enclosure_has_no_unit_and_is_defined_at_a_point(length):
    points = sphere() * length
    eyes = torch.stack([torch.tensor([0.3, 0.2, 0.1]).double() * length, points[0]])
    found = enclosures(points, eyes)
    assert float(found[0]) == 1.0 and 0.4 < float(found[1]) < 0.6
    assert enclosures(points[:1], points[:1]).tolist() == [1 / 96]


def test_only_in_a_room_are_views_beyond_walls_left_out():
    enclosure = torch.tensor([0.9, 0.9, 0.2, 0.5]).double()
    inside = torch.tensor([0.0, 0.0, -9.0, -9.0]).double()
    assert outside_of_a_room(enclosure, inside, 0.75).tolist() == [False, False, True, True]
    outside = torch.tensor([-9.0, -9.0, 0.0, 0.0]).double()
    assert not outside_of_a_room(enclosure, outside, 0.75).any()
    assert not outside_of_a_room(enclosure, inside, math.inf).any()


def views_beyond_walls(scene: Gaussians, least: float) -> int:
    """Number of 48 sampled views that stand outside of the box that holds nearly all Gaussians.
    Candidates are few: of more, enough are within the walls without the rule."""
    low, high = scene.means.double().quantile(torch.tensor([0.001, 0.999]).double(), dim=0)
    count = 0
    for seed in (0, 3):
        with use_settings(ViewSamplingSettings(room_enclosure=least, candidates_per_view=5)):
            views = Sampler(scene).views(24, seed)
        eyes = -(views.viewmats[:, :3, :3].mT @ views.viewmats[:, :3, 3:])[..., 0]
        count += int(((eyes < low) | (eyes > high)).any(dim=1).sum())
    return count


def test_a_closed_room_is_not_seen_from_beyond_its_walls():
    scene = ps.example_room()
    assert views_beyond_walls(scene, least=math.inf) > 0
    assert views_beyond_walls(scene, least=0.75) == 0


@pytest.mark.parametrize("scene", [room(), tower()], ids=["without a ceiling", "an object"])
def test_scenes_that_are_not_closed_keep_their_views(scene):
    with use_settings(ViewSamplingSettings(room_enclosure=math.inf)):
        without = Sampler(scene).views(12)
    assert torch.equal(Sampler(scene).views(12).viewmats, without.viewmats)
