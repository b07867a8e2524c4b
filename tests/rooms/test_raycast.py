"""Ray casting of the built-in rooms against analytic distances, and its parts against one another."""

import math

import pytest
import torch

from pointsplat_ns.rooms import make_room
from pointsplat_ns.rooms.raycast import (
    BOX,
    CHARTS,
    CYLINDER,
    ELLIPSOID,
    Primitives,
    chart_points,
    chart_starts,
    occluded,
    surface,
    trace,
    trace_camera,
    unit_interval,
)


def solids(*rows):
    """A 6 x 6 x 3 room and the given (kind, center, half, yaw)."""
    rows = [(BOX, (0, 0, 1.5), (3, 3, 1.5), 0.0), *rows]
    kind, center, half, yaw = zip(*rows, strict=True)
    return Primitives(
        torch.tensor(kind),
        torch.tensor(center, dtype=torch.float32),
        torch.tensor(half, dtype=torch.float32),
        torch.tensor(yaw, dtype=torch.float32),
        torch.ones(len(rows), dtype=torch.bool),
    )


def ray(origin, direction):
    return torch.tensor(origin, dtype=torch.float32)[:, None], torch.tensor(direction, dtype=torch.float32)[:, None]


@pytest.mark.parametrize(
    ("solid", "origin", "direction", "expected"),
    [
        ((BOX, (1, 0, 1), (0.5, 0.5, 0.5), 0.0), (-2, 0, 1), (1, 0, 0), 2.5),
        # Turned by 45 degrees the box meets the ray with its edge, half a diagonal before its middle.
        ((BOX, (1, 0, 1), (0.5, 0.5, 0.5), math.pi / 4), (-2, 0, 1), (1, 0, 0), 3 - math.sqrt(0.5)),
        ((ELLIPSOID, (1, 0, 1), (0.5, 0.5, 0.5), 0.3), (-2, 0.3, 1), (1, 0, 0), 3 - 0.4),
        ((ELLIPSOID, (1, 0, 1), (0.5, 0.2, 0.8), 0.0), (1, 0, 2.5), (0, 0, -1), 0.7),
        ((CYLINDER, (1, 0, 1), (0.5, 0.5, 0.4), 0.0), (-2, 0.3, 1), (2, 0, 0), (3 - 0.4) / 2),
        ((CYLINDER, (1, 0, 1), (0.5, 0.5, 0.4), 0.0), (1, 0.2, 2), (0, 0, -1), 0.6),
        ((CYLINDER, (1, 0, 1), (0.5, 0.5, 0.4), 0.0), (-2, 0, 1.5), (1, 0, 0), 5.0),  # passes above, meets the wall
    ],
)
def test_first_hit_equals_the_analytic_distance(solid, origin, direction, expected):
    t, index, buried = trace(solids(solid), *ray(origin, direction))
    assert float(t) == pytest.approx(expected, abs=2e-6)  # float32 at distances of metres
    assert int(index) == (0 if expected == 5.0 else 1) and not bool(buried)


def test_a_ray_from_inside_a_solid_says_so():
    prims = solids((ELLIPSOID, (1, 0, 1), (0.5, 0.5, 0.5), 0.0))
    assert bool(trace(prims, *ray((1, 0.1, 1), (1, 0, 0)))[2])


def test_intervals_in_float32_agree_with_float64_at_extremes():
    generator = torch.Generator().manual_seed(5)
    origin = torch.randn(3, 2000, generator=generator, dtype=torch.float64) * 3
    direction = torch.randn(3, 2000, generator=generator, dtype=torch.float64)
    direction[0, :200], direction[1, 200:400], direction[2, 400:600] = 0, 1e-8, 0  # along the slabs
    direction[:2, 600:700] = 0  # along the cylinder
    for scale in (1e-3, 1.0, 1e3):  # rays of very different length
        for kind in (BOX, ELLIPSOID, CYLINDER):
            exact = unit_interval(kind, origin.unbind(0), (direction * scale).unbind(0))
            fast = unit_interval(kind, origin.float().unbind(0), (direction * scale).float().unbind(0))
            clear = (exact[1] - exact[0]) * scale > 1e-2  # away from grazing hits
            assert int(clear.sum()) > 50
            for a, b in zip(exact, fast, strict=True):
                assert torch.allclose(a[clear] * scale, b[clear].double() * scale, atol=1e-3, rtol=1e-4)


def test_shadow_rays_stop_at_solids_between_and_not_behind():
    prims = solids((BOX, (0, 0, 1), (0.2, 0.2, 0.2), 0.0))
    origin = torch.tensor([[-1.0, 0, 1], [-1.0, 0, 2], [0.5, 0, 1]]).T
    assert occluded(prims, origin, torch.tensor([1.0, 0, 1])).tolist() == [True, False, False]
    lamp = Primitives(prims.kind, prims.center, prims.half, prims.yaw, torch.tensor([True, False]))
    assert not occluded(lamp, origin, torch.tensor([1.0, 0, 1])).any()


@pytest.mark.parametrize("seed", [0, 3])
def test_texture_coordinates_of_every_surface_invert(seed):
    prims = make_room(seed).spec.primitives
    generator = torch.Generator().manual_seed(seed)
    starts = chart_starts(prims)
    for p in range(len(prims)):
        for face in range(CHARTS[int(prims.kind[p])]):
            u, v = 0.2 + 0.6 * torch.rand(2, 20, generator=generator)  # within a cap's disc as well
            points, normal = chart_points(prims, p, face, u, v)
            hits = surface(prims, points, torch.full((20,), p))
            assert torch.all(hits.chart == starts[p] + face)
            # Points are metres from the origin and solids centimetres thin: 1e-7 * 5 / 0.01.
            assert torch.allclose(hits.u, u, atol=1e-3) and torch.allclose(hits.v, v, atol=1e-3)
            assert torch.allclose(hits.normal, normal, atol=2e-3)


def test_screen_rectangles_lose_no_hit():
    prims = make_room(2).spec.primitives
    generator = torch.Generator().manual_seed(1)
    K = torch.tensor([[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]])
    v, u = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    rays = torch.stack([(u - 32) / 40, (v - 24) / 40, torch.ones_like(u)])
    for _ in range(4):
        rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
        c2w = torch.eye(4)
        c2w[:3, :3], c2w[:3, 3] = rotation * torch.det(rotation), torch.tensor([0.1, 0.2, 1.4])
        z, index = trace_camera(prims, c2w, rays, K, 1)
        directions = (c2w[:3, :3] @ rays.reshape(3, -1)).contiguous()
        t, expected, _ = trace(prims, c2w[:3, 3:].expand(3, directions.shape[1]), directions)
        assert torch.allclose(z.reshape(-1), t, rtol=1e-5)
        # Solids that touch may swap where their surfaces coincide.
        assert (index.reshape(-1) != expected).float().mean() < 0.002
