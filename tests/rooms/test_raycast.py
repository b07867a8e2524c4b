"""Ray casting of the built-in rooms against analytic distances, and its parts against one another."""

import math

import pytest
import torch

from pointsplat_ns.rooms import capture_path, make_room
from pointsplat_ns.rooms.raycast import Solids, chart_points, occluded, surface, trace


def room_with(*rows):
    """A 6 x 6 x 3 room and the given (center, half, round)."""
    center, half, round = zip(((0, 0, 1.5), (3, 3, 1.5), False), *rows, strict=True)
    return Solids(
        torch.tensor(center), torch.tensor(half), torch.tensor(round), torch.ones(len(half), dtype=torch.bool)
    )


def ray(origin, direction):
    return torch.tensor(origin).float()[:, None], torch.tensor(direction).float()[:, None]


@pytest.mark.parametrize(
    ("solid", "origin", "direction", "expected"),
    [
        (((1.0, 0, 1), (0.5, 0.5, 0.5), False), (-2, 0, 1), (1, 0, 0), 2.5),
        (((1.0, 0, 1), (0.5, 0.5, 0.5), False), (-2, 0, 1), (2, 0, 0), 1.25),
        (((1.0, 0, 1), (0.5, 0.5, 0.5), True), (-2, 0.3, 1), (1, 0, 0), 3 - 0.4),
        (((1.0, 0, 1), (0.5, 0.2, 0.8), True), (1, 0, 2.5), (0, 0, -1), 0.7),
        (((1.0, 0, 1), (0.5, 0.5, 0.4), False), (-2, 0, 1.5), (1, 0, 0), 5.0),  # passes above, meets the wall
        (((1.0, 0, 1), (0.5, 0.5, 0.4), True), (-2, 0.49, 1.3), (1, 0, 0), 5.0),  # within the ellipsoid's box only
    ],
)
def test_first_hit_equals_the_analytic_distance(solid, origin, direction, expected):
    t, index = trace(room_with(solid), *ray(origin, direction))
    assert float(t) == pytest.approx(expected, abs=2e-6)  # float32 at distances of metres
    assert int(index) == (0 if expected == 5.0 else 1)


def test_intervals_in_float32_agree_with_float64_at_extremes():
    generator = torch.Generator().manual_seed(5)
    origin = torch.randn(3, 2000, generator=generator, dtype=torch.float64) * 3
    direction = torch.randn(3, 2000, generator=generator, dtype=torch.float64)
    direction[0, :200], direction[1, 200:400], direction[2, 400:600] = 0, 1e-8, 0  # along the faces
    fast = room_with(((0.0, 0, 0), (1, 1, 1), False), ((0.0, 0, 0), (1, 1, 1), True))
    slow = Solids(fast.center.double(), fast.half.double(), fast.round, fast.opaque)
    for scale in (1e-3, 1.0, 1e3):  # rays of very different length
        for number in (1, 2):
            exact = slow.interval(number, origin, direction * scale)
            found = fast.interval(number, origin.float(), (direction * scale).float())
            clear = (exact[1] - exact[0]) * scale > 1e-2  # away from grazing hits
            assert int(clear.sum()) > 50
            for a, b in zip(exact, found, strict=True):
                assert torch.allclose(a[clear] * scale, b[clear].double() * scale, atol=1e-3, rtol=1e-4)


def test_what_stands_between_a_point_and_a_light_hides_it_unless_it_casts_no_shadow():
    solids = room_with(((0.0, 0, 1), (0.3, 0.3, 0.3), True))
    points, lamp = torch.tensor([[-1.0, -1], [0, 2], [1, 1]]), torch.tensor([1.0, 0, 1])
    assert occluded(solids, points, lamp).tolist() == [True, False]
    clear = Solids(solids.center, solids.half, solids.round, torch.zeros(2, dtype=torch.bool))
    assert not occluded(clear, points, lamp).any()


def test_surface_coordinates_and_normals_invert_chart_points():
    solids = make_room(1).solids
    u, v = torch.rand(2, 40, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
    for chart in range(6 * len(solids)):
        points, normals = chart_points(solids, chart, u, v)
        hits = surface(solids, points, torch.full((40,), chart // 6))
        assert (hits.chart == chart).all()
        assert torch.allclose(hits.u, u, atol=1e-3) and torch.allclose(hits.v, v, atol=1e-3)  # thin solids are 1 cm
        assert torch.allclose(hits.normal, normals, atol=1e-3)
        outward = ((points - solids.center[chart // 6][:, None]) * normals).sum(0)
        assert (outward < 0).all() if chart < 6 else (outward > 0).all()


def test_a_cameras_rays_hit_what_single_rays_hit():
    room = make_room(2)
    for pose in capture_path(room, 12, 2)[::4]:
        x = torch.linspace(-0.8, 0.8, 40)
        v, u = torch.meshgrid(0.75 * x, x, indexing="ij")
        ways = pose[:3, :3] @ torch.stack([u, v, torch.ones_like(u)]).flatten(1)
        z, index = trace(room.solids, pose[:3, 3:], ways)
        expected, others = trace(room.solids, pose[:3, 3:].expand(3, ways.shape[1]), ways)
        assert torch.equal(z, expected) and torch.equal(index, others)
        assert math.isfinite(float(z.sum()))
