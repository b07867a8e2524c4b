"""Places on the Earth: known points, and that UTM coordinates are conformal and true to scale on
the middle meridian, which only one projection is."""

import math

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.geometry.earth import Place

LEVEL = torch.eye(3, dtype=torch.float64)
A = 6378137.0
B = 6356752.314245
"""Half axes of WGS 84, metres."""


def at(place: str, *point: float) -> torch.Tensor:
    return Place.parse(place).frame(torch.tensor(point, dtype=torch.float64), LEVEL)


def on_ellipsoid(latitude: float, longitude: float) -> torch.Tensor:
    """Degrees to metres, by the angle that a circle has where the ellipse has a latitude."""
    phi = math.radians(latitude)
    turn = math.radians(longitude)
    reduced = math.atan2(B * math.sin(phi), A * math.cos(phi))
    across = A * math.cos(reduced)
    return torch.tensor(
        [across * math.cos(turn), across * math.sin(turn), B * math.sin(reduced)],
        dtype=torch.float64,
    )


def meridian(latitude: float, steps: int = 20_000) -> float:
    """Metres from the equator along an ellipse, by Simpson's rule."""
    e2 = 1 - (B / A) ** 2
    phi = torch.linspace(0, math.radians(latitude), 2 * steps + 1, dtype=torch.float64)
    curve = A * (1 - e2) / (1 - e2 * phi.sin() ** 2) ** 1.5
    return float(
        (curve[0] + curve[-1] + 4 * curve[1::2].sum() + 2 * curve[2:-1:2].sum())
        * (phi[1] - phi[0])
        / 3
    )


@pytest.mark.parametrize(
    ("latitude", "longitude", "height", "axes"),
    [
        (0, 0, 0, [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        (0, 90, 10, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
        (90, 0, -5, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        (-90, 0, 0, [[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
        (-45, -180, 1e5, [[0, -1, 0], [-(0.5**0.5), 0, 0.5**0.5], [-(0.5**0.5), 0, -(0.5**0.5)]]),
    ],
)
def test_east_north_and_up_stand_on_the_ellipsoid(latitude, longitude, height, axes):
    found = at(f"{latitude},{longitude},{height}", 0, 0, 0)
    assert torch.allclose(found[:3, :3].T, torch.tensor(axes, dtype=torch.float64), atol=1e-12)
    wanted = on_ellipsoid(latitude, longitude) + height * found[:3, 2]
    assert torch.allclose(found[:3, 3], wanted, rtol=0, atol=1e-5)
    moved = at(f"{latitude},{longitude},{height}", 3, -4, 5)
    assert torch.allclose(
        moved[:3, 3], found[:3] @ torch.tensor([3.0, -4, 5, 1], dtype=torch.float64), atol=1e-8
    )


@pytest.mark.parametrize("latitude", [0.0, 1e-6, 12.5, 48.8, 80.0])
@pytest.mark.parametrize(
    ("place", "longitude"), [("EPSG:32632", 9), ("epsg:25832", 9), ("EPSG:32660", 177)]
)
def test_the_middle_meridian_of_a_zone_has_0_9996_of_its_length(latitude, place, longitude):
    found = at(place, 5e5, 0.9996 * meridian(latitude), 0)
    assert torch.allclose(found[:3, 3], on_ellipsoid(latitude, longitude), rtol=0, atol=1e-3)
    assert float(found[:3, 1].norm()) == pytest.approx(1 / 0.9996, abs=1e-9)


@pytest.mark.parametrize("point", [(1.6e5, 1e5), (8.4e5, 5.4e6), (3e5, 9.3e6), (499_999.0, 1.0)])
@pytest.mark.parametrize("place", ["EPSG:32601", "EPSG:32731"])
def test_a_zone_is_conformal_and_its_frame_follows_it(point, place):
    east, north = point if place == "EPSG:32601" else (point[0], 1e7 - point[1])
    here = at(place, east, north, 30)
    step = 50.0
    ways = [
        (at(place, east + x, north + y, 30) - at(place, east - x, north - y, 30))[:3, 3]
        / (2 * step)
        for x, y in ((step, 0), (0, step))
    ]
    assert float(ways[0].norm() / ways[1].norm()) == pytest.approx(1, abs=1e-4 * 30 / 6.4e2)
    for column, way in zip(
        here[:3, :2].T, ways, strict=True
    ):  # radii along and across differ a little 30 m up
        assert torch.allclose(column, way, atol=1e-6)
    scale = float(here[:3, 1].norm())
    assert torch.allclose(here[:3, :3].T @ here[:3, :3], scale**2 * LEVEL, atol=1e-9)


def test_a_published_point_is_found_and_the_south_mirrors_the_north():
    tower = at("EPSG:32617", 630_084, 4_833_438, 0)[
        :3, 3
    ]  # 43 38' 33.24" N, 79 23' 13.7" W, to a tenth of a second
    assert (
        float(
            (
                tower - on_ellipsoid(43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600))
            ).norm()
        )
        < 3
    )
    south = at("EPSG:32717", 630_084, 1e7 - 4_833_438, 0)[:3, 3]
    assert torch.allclose(south, tower * torch.tensor([1.0, 1.0, -1.0]), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "text", ["", "EPSG:4326", "EPSG:32661", "EPSG:32600", "91,0", "1", "1,2,3,4", "nan,0", "a,b"]
)
def test_what_is_no_place_is_refused(text):
    with pytest.raises(
        ps.PointSplatError, match="expected a UTM zone, such as EPSG:32632, or LATITUDE"
    ):
        Place.parse(text)


@pytest.mark.parametrize("point", [(0, 0, 0), (5e5, 2e7, 0), (math.nan, 0, 0)])
def test_a_scene_outside_of_the_zone_is_refused(point):
    with pytest.raises(ps.SceneError, match="expected coordinates of UTM zone 32"):
        at("EPSG:32632", *point)
