"""Geo-referencing: UTM and geographic coordinates in the Earth-centred frame of 3D Tiles
(EPSG:4978, metres)."""

from __future__ import annotations

import cmath
import math
import re
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.system.tensors import DOUBLES

# WGS 84; the ellipsoid of ETRS89 is 0.1 mm smaller at the poles
_RADIUS = 6378137.0
_FLATTENING = 1 / 298.257223563
_N = _FLATTENING / (2 - _FLATTENING)
_MERIDIAN = _RADIUS / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_TO_SPHERE = (
    _N / 2 - 2 * _N**2 / 3 + 37 * _N**3 / 96 - _N**4 / 360,
    _N**2 / 48 + _N**3 / 15 - 437 * _N**4 / 1440,
    17 * _N**3 / 480 - 37 * _N**4 / 840,
    4397 * _N**4 / 161280,
)
_FROM_CONFORMAL = (
    2 * _N - 2 * _N**2 / 3 - 2 * _N**3 + 116 * _N**4 / 45,
    7 * _N**2 / 3 - 8 * _N**3 / 5 - 227 * _N**4 / 45,
    56 * _N**3 / 15 - 136 * _N**4 / 35,
    4279 * _N**4 / 630,
)


@dataclass(frozen=True)
class Place:
    """Position of a scene on the Earth: its coordinates are in a UTM zone, or its origin is at a
    geographic point."""

    zone: int | None = None
    """1 to 60; negative south of the equator."""
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Latitude and longitude in degrees, and metres above the ellipsoid, without a zone."""

    @classmethod
    def parse(cls, text: str) -> Place:
        """Parse EPSG:32632 (UTM of WGS 84; 258.. for ETRS89), LATITUDE,LONGITUDE or
        LATITUDE,LONGITUDE,HEIGHT. Raises PointSplatError for any other text."""
        code = re.fullmatch(r"EPSG:(326|327|258)(\d\d)", text.strip(), re.IGNORECASE)
        if code and 1 <= int(code[2]) <= 60:
            return cls(-int(code[2]) if code[1] == "327" else int(code[2]))
        try:
            latitude, longitude, *height = map(float, text.split(","))
            (above,) = height or [0.0]
            if abs(latitude) <= 90 and abs(longitude) <= 360 and abs(above) < 1e8:
                return cls(None, (latitude, longitude, above))
        except ValueError:
            pass
        raise PointSplatError(
            f"the place is {text!r}; expected a UTM zone, such as EPSG:32632, or "
            "LATITUDE,LONGITUDE,HEIGHT in degrees and metres"
        )

    def frame(self, point: Tensor, turn: Tensor) -> Tensor:
        """The matrix (4, 4) float64 from a scene's axes, centred at one of its points, to the
        Earth-centred frame.

        Args:
            point: (3,) float64, in coordinates of the zone, or relative to the scene's origin.
            turn: (3, 3) float64, rotates the scene to z-up, without a zone. y is north.

        Raises:
            SceneError: if the point is outside of the zone.
        """
        matrix = torch.eye(4, **DOUBLES)
        if self.zone is None:
            latitude, longitude = (math.radians(degrees) for degrees in self.point[:2])
            up = _upwards(latitude, longitude)
            north = _upwards(latitude + math.pi / 2, longitude)
            matrix[:3, :3] = torch.stack([torch.linalg.cross(north, up), north, up], dim=1) @ turn
            matrix[:3, 3] = (
                _earth_centred(latitude, longitude, self.point[2]) + matrix[:3, :3] @ point
            )
            return matrix
        east, north_of_equator, height = point.tolist()
        if self.zone < 0:
            north_of_equator -= 1e7
        if not (abs(east - 5e5) < 4.5e5 and abs(north_of_equator) < 1e7):
            raise SceneError(
                f"the scene lies at {east:.7g} {point[1]:.7g}; expected coordinates of UTM zone "
                f"{abs(self.zone)}"
            )
        step = 100.0  # metres; the relative error by curvature and rounding is below 1e-10
        behind, ahead = (
            _earth_centred(*_unprojected(east, north_of_equator + way, self.zone), height)
            for way in (-step, step)
        )
        at = _unprojected(east, north_of_equator, self.zone)
        up = _upwards(*at)
        north = (ahead - behind) / (2 * step)
        axes = torch.stack([torch.linalg.cross(north, up), north, north.norm() * up], dim=1)
        matrix[:3, :3] = axes
        matrix[:3, 3] = _earth_centred(*at, height)
        return matrix


def local_frame(point: Tensor) -> Tensor | None:
    """The matrix (4, 4) float64 from axes east, north and up at a point (3,) to the Earth-centred
    frame, metres. None if the point is not within 100 km of the ellipsoid."""
    squeeze = (1 - _FLATTENING) ** 2
    # The normal of the ellipsoid below a point at a height of 1 km is 1e-6 from this one.
    up = point / torch.tensor([1.0, 1.0, squeeze], **DOUBLES)
    if not 0 < float(up.norm()) < 1e8:
        return None
    up = up / up.norm()
    latitude = math.asin(float(up[2].clamp(-1, 1)))
    longitude = math.atan2(float(point[1]), float(point[0]))
    if float((_earth_centred(latitude, longitude, 0.0) - point).norm()) > 1e5:
        return None
    return Place(None, (math.degrees(latitude), math.degrees(longitude), 0.0)).frame(
        torch.zeros(3, **DOUBLES), torch.eye(3, **DOUBLES)
    )


def _upwards(latitude: float, longitude: float) -> Tensor:
    """The normal (3,) of the ellipsoid; angles in radians."""
    level = math.cos(latitude)
    return torch.tensor(
        [level * math.cos(longitude), level * math.sin(longitude), math.sin(latitude)], **DOUBLES
    )


def _earth_centred(latitude: float, longitude: float, height: float) -> Tensor:
    """The position (3,) of a point, metres."""
    squeeze = (1 - _FLATTENING) ** 2
    across = _RADIUS / math.sqrt(math.cos(latitude) ** 2 + squeeze * math.sin(latitude) ** 2)
    up = _upwards(latitude, longitude)
    return height * up + across * up * torch.tensor([1.0, 1.0, squeeze], **DOUBLES)


def _unprojected(east: float, north: float, zone: int) -> tuple[float, float]:
    """Latitude and longitude, radians, of a point in a UTM zone, metres from the equator: Krueger's
    series, 1912, with an error below a millimetre within 3000 km of the central meridian."""
    plane = complex(north, east - 5e5) / (0.9996 * _MERIDIAN)
    sphere = plane - sum(term * cmath.sin(2 * k * plane) for k, term in enumerate(_TO_SPHERE, 1))
    conformal = math.asin(math.sin(sphere.real) / math.cosh(sphere.imag))
    latitude = conformal + sum(
        term * math.sin(2 * k * conformal) for k, term in enumerate(_FROM_CONFORMAL, 1)
    )
    longitude = math.radians(6 * abs(zone) - 183) + math.atan2(
        math.sinh(sphere.imag), math.cos(sphere.real)
    )
    return latitude, longitude
