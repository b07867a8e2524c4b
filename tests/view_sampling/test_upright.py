"""The upward direction and the opening view."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from upright_scenes import TURNS, plates, room, tower, turned

from making import SHARED_DATA, ball, box_room, in_pictures, splats
from pointsplat_ns.api import example_room
from pointsplat_ns.geometry.transforms import direction_of
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.tools.pages.flight import FlightFrame
from pointsplat_ns.tools.scene_info import info
from pointsplat_ns.view_sampling import upright
from pointsplat_ns.view_sampling.content import thinned
from pointsplat_ns.view_sampling.opening_views import opening_views
from pointsplat_ns.view_sampling.poses import look_at, views_of
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings
from pointsplat_ns.view_sampling.upright import Up, upright_axis

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@pytest.mark.parametrize(
    "turn", TURNS[1:]
)  # along world axes, y is preferred to the floor of a room
@pytest.mark.parametrize("make", [room, tower])
def test_the_upright_axis_is_found_however_the_scene_is_turned(make, turn):
    axis = upright_axis(Sampler(turned(make(), turn)).surface)
    # 3 degrees: directions are refined in steps of half a degree
    assert float((axis @ torch.from_numpy(turn.apply(UP.numpy()))).abs()) > math.cos(
        math.radians(3)
    )


def test_up_is_a_guess_without_evidence():
    up = Sampler(ball(3000, log_size=math.log(0.05))).up
    assert float(up.direction.norm()) == pytest.approx(1) and not up.sure


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not there")
def test_a_published_room_stands_upright():
    up = Sampler(read_scene(SHARED_DATA / "splats/mujoco_tabletop/scene.spz")).up
    assert str(up) == "y", "0.29 more is seen from above, in logarithm; 0.25 are needed"


@pytest.mark.parametrize("size", [-math.inf, -300.0, 80.0])
def test_a_scene_with_positions_and_sizes_at_their_extremes_has_an_up(size):
    scene = box_room(0)
    far = scene.means.clone()
    faint = scene.opacities.clone()
    scales = scene.scales.clone()
    far[0] = 1e30
    far[1] = math.nan
    faint[2:300] = -20.0
    scales[300:] = size
    sampler = Sampler(scene.replace(means=far, opacities=faint, scales=scales))
    assert bool(sampler.surface.points.isfinite().all()) and bool(
        sampler.surface.normals.isfinite().all()
    )
    assert float(sampler.up.direction.norm()) == pytest.approx(1)


def statue() -> Gaussians:
    """A figure of 1 x 2.4 units on a block; its face, at x = 0.05, has many more Gaussians than its
    back."""
    fine = plates(((0.05, 0, 2.2), (0, 0.5, 1.2)), density=300)
    block = [((0, 0, z), (0.5, 0.5, 0)) for z in (0.8, 0.9, 1.0)]
    coarse = plates(((-0.05, 0, 2.2), (0, 0.5, 1.2)), *block, density=60)
    return Gaussians.cat([fine.replace(scales=fine.scales - 0.7), coarse])


def corner() -> Gaussians:
    """Two walls, a floor, and a table of which photos showed the top."""
    table = plates(((0.3, 0.3, 0.9), (0.8, 0.8, 0)), density=300)
    walls = plates(
        ((-2, 0, 1.2), (0, 2, 1.2)), ((0, -2, 1.2), (2, 0, 1.2)), ((0, 0, 0), (2, 2, 0)), density=40
    )
    return Gaussians.cat([table, walls.replace(scales=walls.scales + 0.5)])


@pytest.mark.parametrize(("width", "height"), [(960, 600), (400, 500)])
@pytest.mark.parametrize("turn", TURNS[:2])
def test_an_object_is_whole_and_upright_from_every_side(turn, width, height):
    scene = turned(statue(), turn)
    up = torch.from_numpy(turn.apply(UP.numpy()))
    found = opening_views(scene, 3, width, height, Up(up))
    assert found.whole and len(found.views) == 3
    assert bool(in_pictures(found.views, scene.means.double()).all()), "nothing is cut off"
    down = found.views.viewmats[:, 1, :3]
    assert (
        bool((down @ up < -0.9).all())
        and float((found.views.viewmats[:, 0, :3] @ up).abs().max()) < 1e-9
    )
    eyes = torch.linalg.inv(found.views.viewmats)[:, :3, 3]
    assert float(torch.cdist(eyes, eyes).fill_diagonal_(9.0).min()) > 1.0, (
        "the views are from different sides"
    )


@pytest.mark.parametrize(
    "axis", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
)
def test_up_is_the_side_from_which_more_is_seen(axis):
    turn, _ = Rotation.align_vectors([axis], [[0, 0, 1]])
    scene = turned(corner(), turn)
    assert Sampler(scene).up.direction.tolist() == list(map(float, axis))
    if axis == (0, 1, 0):
        with use_settings(replace(DEFAULT_SETTINGS, min_seen_from_above=math.inf)):
            assert Sampler(scene).up.direction.tolist() == [0.0, -1.0, 0.0]


def heap() -> Gaussians:
    """Many small Gaussians on a floor of few large ones, which hides them from below."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(3000, 3, generator=generator) * 2 - 1
    small = splats(
        places * torch.tensor([1.0, 1.0, 0.2]) + torch.tensor([0.0, 0.0, 0.3]), -3.5, 4.0
    )
    floor = plates(((0, 0, 0), (3, 3, 0)), density=15)
    return Gaussians.cat([small, floor.replace(scales=floor.scales + 1.0)])


def meadow() -> Gaussians:
    """Gaussians of all orientations in a thin level layer."""
    generator = torch.Generator().manual_seed(0)
    quats = torch.randn(4000, 4, generator=generator)
    means = torch.rand(4000, 3, generator=generator) * torch.tensor([10.0, 10.0, 0.2])
    return splats(means, torch.tensor([-2.0, -2.0, -4.0]).expand(4000, 3), 4.0).replace(quats=quats)


@pytest.mark.parametrize(
    ("make", "right", "wrong"), [(heap, "z", "-z"), (meadow, "z", "x"), (meadow, "z", "-y")]
)
def test_a_declared_axis_that_the_scene_contradicts_is_doubted_once(make, right, wrong, caplog):
    upright._warn_of_contradiction.cache_clear()
    up = Sampler(make().replace(up=right)).up
    assert (str(up), up.sure, caplog.messages) == (right, True, [])
    for _ in range(2):
        up = Sampler(make().replace(up=wrong)).up
        assert str(up) == f"{wrong} (declared, but the scene suggests {right})" and not up.sure
    assert caplog.messages == [
        f"the file declares {wrong} as up, but the scene suggests {right}; if it is right, set it "
        f"with --up={right}"
    ]
    assert Sampler(make().replace(up=wrong), up=Up(direction_of(wrong))).up.sure
    found = info(make().replace(up=wrong))
    assert (found.up_instead, found.up_text) == (right, str(up))
    assert FlightFrame.of(make().replace(up=wrong)).up.instead == right


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the files are not there")
@pytest.mark.parametrize(
    ("name", "axis"),
    [
        ("mujoco_tabletop/scene.spz", "y"),
        ("apt_bathroom/Toilet.compressed.ply", "-y"),
        ("pc_statue_massa/massa.sog", "-y"),
    ],
)
def test_true_axes_of_published_scenes_are_not_doubted(name, axis):
    scene = read_scene(SHARED_DATA / "splats" / name).replace(up=axis)
    assert str(Sampler(scene).up) == axis


def test_a_room_is_first_seen_from_inside_and_then_from_other_sides():
    scene = thinned(example_room(), 6000)
    found = opening_views(scene, 4)
    assert not found.whole and len(found.views) == 4
    eyes = torch.linalg.inv(found.views.viewmats)[:, :3, 3]
    low, high = (scene.means.double().quantile(share, dim=0) for share in (0.01, 0.99))
    assert bool(((eyes > low) & (eyes < high)).all()), "inside"
    shown = in_pictures(found.views, scene.means.double())
    assert float(shown.any(0).double().mean()) > float(shown[0].double().mean()) + 0.1, (
        "the others show more"
    )


def test_photos_of_a_room_come_before_a_view_from_outside():
    scene = room()
    eyes = torch.tensor([[-1.5, -1.0, 0.3], [1.5, 1.0, 0.3], [0.0, 0.0, 0.2]], dtype=torch.float64)
    targets = torch.tensor(
        [[1.5, 1.0, -0.5], [-1.5, -1.0, -0.5], [0.0, 0.0, 1.2]], dtype=torch.float64
    )
    photos = replace(
        views_of(look_at(eyes, targets, UP), 64, 40, 5.0), background=torch.tensor([0.1, 0.2, 0.3])
    )
    found = opening_views(scene, 2, up=Up(UP), known=photos)
    assert not found.whole and found.views.background.tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert all(
        any(torch.equal(view, photo) for photo in photos.viewmats) for view in found.views.viewmats
    )
    assert not torch.equal(found.views.viewmats[0], photos.viewmats[2]), "the ceiling shows least"


def test_photos_that_cut_an_object_off_come_after_it_whole():
    scene = statue()
    near = look_at(
        torch.tensor([[1.0, 0.0, 1.6]]).double(), torch.tensor([[0.0, 0.0, 1.6]]).double(), UP
    )
    photos = replace(views_of(near, 64, 40, 5.0), rasterize_mode="antialiased")
    found = opening_views(scene, 1, known=photos)
    assert found.whole and found.views.rasterize_mode == "antialiased"
