"""Which way is up in a scene without cameras, and the upright box around it."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from upright_scenes import TURNS, plates, room, tower, turned

from making import ball, box_room
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.looking.content import content_size
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import PhotoPlaces
from pointsplat_ns.looking.upright import UprightBox, axis_named, level_directions, levelness, pointing_up, upright_axis

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
PLACES = torch.linspace(0, 2 * math.pi, 61)[:60]
EDGES = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]


def degrees_between(a: torch.Tensor, b: torch.Tensor) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, float(a @ b)))))


@pytest.mark.parametrize("turn", TURNS[1:])  # along world axes, walls of a room may be preferred to its floor
@pytest.mark.parametrize("make", [room, tower])
def test_the_upright_axis_is_found_however_the_scene_is_turned(make, turn):
    scene = turned(make(), turn)
    axis = upright_axis(Surface.of(scene, *content_size(scene)))
    # 3 degrees: directions are refined in steps of half a degree, from points of which some lie across
    angle = degrees_between(axis, torch.from_numpy(turn.apply(UP.numpy())))
    assert min(angle, 180 - angle) < 3


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, -1, 0)])
def test_z_or_minus_y_is_up_where_the_scene_stands_along_it(axis):
    turn, _ = Rotation.align_vectors([axis], [[0, 0, 1]])
    scene = turned(tower(), turn)
    surface = Surface.of(scene, *content_size(scene))
    assert pointing_up(surface, upright_axis(surface)).direction.tolist() == list(axis)


def test_up_is_a_guess_without_evidence():
    scene = ball(3000, log_size=math.log(0.05))
    surface = Surface.of(scene, *content_size(scene))
    cloud = 3 * torch.randn(surface.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shapeless = replace(surface, points=cloud, flatness=torch.zeros_like(surface.flatness))
    up = pointing_up(shapeless, upright_axis(shapeless))
    assert float(up.direction.norm()) == pytest.approx(1) and not up.sure


@pytest.mark.parametrize("turn", TURNS)
def test_the_box_turns_with_the_scene(turn):
    scene = turned(box_room(0, 3000), turn)
    centre, size = content_size(scene)
    surface = Surface.of(scene, centre, size)
    box = UprightBox.of(surface, torch.from_numpy(turn.apply(UP.numpy())))
    assert torch.allclose(box.frame @ box.frame.T, torch.eye(3).double(), atol=1e-12)
    found = sorted(((box.high - box.low) * size / 10).tolist())
    # nine tenths of each axis, between walls; 12 %: yaws are 5 degrees apart, and points are drawn at random
    assert found == pytest.approx([2.0, 3.0, 4.0], rel=0.12)
    places = box.places(100, torch.Generator().manual_seed(0))
    heights = box.heights(places)
    assert bool(((heights >= 0) & (heights <= 1)).all())


def test_level_directions_are_level_for_any_up():
    for up in (*torch.eye(3).double(), torch.tensor([0.6, 0.0, -0.8]).double()):
        found = level_directions(up, torch.linspace(0, 6, 7).double())
        assert torch.allclose(found @ up, torch.zeros(7).double(), atol=1e-12)
        assert torch.allclose(found.norm(dim=1), torch.ones(7).double(), atol=1e-12)


def test_points_stand_for_what_can_be_seen_and_are_finite():
    scene = box_room(0)
    far = scene.means.clone()
    far[0], far[1] = 1e30, math.nan
    faint = scene.opacities.clone()
    faint[2:300] = -20.0
    surface = Surface.of(scene.replace(means=far, opacities=faint), *content_size(scene))
    assert bool(surface.normals.isfinite().all()) and bool(surface.points.isfinite().all())
    flat = scene.replace(scales=torch.full_like(scene.scales, -math.inf))
    assert bool(Surface.of(flat, *content_size(flat)).points.isfinite().all())


def test_a_wall_hides_what_is_behind_it():
    scene = plates(((1, 0, 0), (0, 1, 1)), ((2, 0, 0), (0, 0.5, 0.5)), density=400)
    surface = Surface.of(scene, torch.zeros(3, dtype=torch.float64), 10.0)
    visible, enclosure = surface.visible_from(torch.tensor([[-1.0, 0, 0], [4.0, 0, 0]], dtype=torch.float64))
    first = surface.points[:, 0] < 1.5
    assert float(visible[0, first].float().mean()) > 0.95 and float(visible[0, ~first].float().mean()) < 0.05
    assert float(visible[1, ~first].float().mean()) > 0.95
    assert bool((enclosure < 0.2).all())
    assert float(surface.clearance(torch.zeros(1, 3).double())) == pytest.approx(1.0, abs=0.1)


def test_places_lie_level_across_the_axis_that_they_do_not_spread_along():
    ring = torch.stack([PLACES.cos(), PLACES.sin(), torch.zeros(60)], dim=1).double() + 5
    shares = torch.full((60,), 1 / 60)
    found = levelness(torch.eye(3).double(), PhotoPlaces(ring, shares))
    assert torch.allclose(found, torch.tensor([0.0, 0.0, 1.0]).double(), atol=0.1)
    # a place that counts for nothing says nothing
    far = torch.cat([ring, torch.tensor([[5.0, 5.0, 1e6]]).double()])
    assert torch.allclose(
        levelness(torch.eye(3).double(), PhotoPlaces(far, torch.cat([shares, torch.zeros(1)]))), found
    )


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-30, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_levelness_is_a_share_for_places_of_any_spread(size, dtype):
    places = (size * torch.stack([PLACES.cos(), PLACES.sin(), 0.1 * PLACES], dim=1).double()).to(dtype)
    for some in (places, places[:1]):
        found = levelness(torch.eye(3).double(), PhotoPlaces(some, torch.full((len(some),), 1 / len(some))))
        assert bool(((found >= 0) & (found <= 1)).all())


def test_where_photos_were_taken_decides_between_axes_that_suit_alike():
    """A cube has three; photos were taken from all around it, at about one height."""
    cube = plates(*(((side * x, side * y, side * z), (1 - x, 1 - y, 1 - z)) for x, y, z in EDGES for side in (-1, 1)))
    surface = Surface.of(cube, *content_size(cube))
    for axis in range(3):
        ring = torch.zeros(60, 3).double()
        ring[:, (axis + 1) % 3], ring[:, (axis + 2) % 3] = 8 * PLACES.cos().double(), 8 * PLACES.sin().double()
        found = upright_axis(surface, PhotoPlaces(ring, torch.full((60,), 1 / 60)))
        assert float(found[axis].abs()) > math.cos(math.radians(3))


@pytest.mark.parametrize(("from_above", "up", "sure"), [(0.3, UP, True), (-0.3, -UP, True), (-0.05, UP, False)])
def test_up_is_sure_where_clearly_more_is_seen_from_above(from_above, up, sure):
    surface = Surface.of(tower(), *content_size(tower()))
    found = pointing_up(surface, UP, from_above)
    assert torch.equal(found.direction, up) and found.sure is sure
    assert str(found).endswith("(a guess)") is not sure


@pytest.mark.parametrize("name", ["w", "", "--z", "zz", "1"])
def test_other_names_of_axes_are_refused(name):
    with pytest.raises(PointSplatError, match="expected x, y, z, -x, -y or -z"):
        axis_named(name)
