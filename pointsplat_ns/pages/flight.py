"""Scenes to fly through in a page: what the scripts of a page need to draw them, compressed as SPZ.

Everything is in units of the content of one scene, so that scenes of any size and place keep the same precision, and
cameras move at a speed that suits them.
"""

from __future__ import annotations

import base64
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats.spz import encode_spz
from pointsplat_ns.looking.content import (
    content_box,
    content_size,
    in_units,
    positions_in_units,
    views_in_units,
)
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.sampling import estimated_up, sample_views
from pointsplat_ns.looking.settings import DEFAULTS
from pointsplat_ns.looking.upright import level_directions
from pointsplat_ns.pruning import need_usable, ply_bytes
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.views import Views

logger = logging.getLogger("pointsplat_ns")

SCRIPTS = ("spz.js", "splats.js", "camera.js", "flight.js")
"""What draws a flight, for :func:`~pointsplat_ns.pages.html.page`, which has to let it have workers."""

VIEWS = 6
"""Number of views, at most, that a page leads to."""

REACH = 2047.0
"""Gaussians farther from the middle of the content (units, 10 to its diagonal) are left out: up to there, positions in
SPZ have steps of 1/4096 of a unit."""

_SIZE = (960, 600)
"""Size of sampled views: the shape of the stage."""


@dataclass(frozen=True, eq=False)
class Stage:
    """Views that scenes of one place are looked at from."""

    centre: Tensor  # [3] float64, of the content, scene units
    size: float  # of the content, scene units
    up: Tensor  # [3] float64
    views: Views  # in units of the content
    inside: bool
    """Whether the first view is from within the content: a room to look around in, not an object to circle about."""

    @staticmethod
    def of(scene: Gaussians, views: Views | None = None) -> Stage:
        """The stage for a scene and smaller ones made of it.

        Args:
            scene: N Gaussians.
            views: where to look from; at most :data:`VIEWS` of them are taken. By default they are sampled. A flight
                begins at the one that has most Gaussians in its picture.

        Raises:
            SceneError: if no Gaussian can be drawn.
            DataError: if nothing of the scene is visible.
        """
        need_usable(scene)
        low, high = content_box(scene)
        centre, size = content_size(scene, (low, high))
        up = estimated_up(scene).cpu()
        if views is None or len(views) == 0:
            views = _sampled(scene, centre, size, up)
        views = views_in_units(views.spread(VIEWS), centre, size)
        shown = _in_picture(positions_in_units(scene.means, centre, size).cpu(), views)
        views = views[shown.argsort(descending=True, stable=True)]
        up = _nearest_axis(-views.viewmats[:, 1, :3].double().mean(0), up)
        half = positions_in_units(high, centre, size).cpu().abs()
        return Stage(centre, size, up, views, bool((_eyes(views)[0].abs() < half).all()))

    def packed(self, scene: Gaussians, name: str, progress: Progress = silent) -> dict[str, str]:
        """A scene for the page: its name, how much it is, and itself, in units of the content, as base64 of SPZ 3.

        Args:
            scene: N Gaussians.
            name: for people.
            progress: called while compressing.
        """
        placed = in_units(scene.detach(), self.centre.to(scene.device), self.size).to("cpu", torch.float32)
        near = placed.usable() & (placed.means.abs() <= REACH).all(1)
        left_out = int((~near).sum())
        if left_out:
            logger.warning("%s: %d Gaussians, very far away or without meaning, are not in the page", name, left_out)
        # A tenth of the time of level 9, for 3 % more bytes.
        spz = base64.b64encode(encode_spz(placed[near], progress, level=6)).decode("ascii")
        megabytes = ply_bytes(len(scene), scene.sh_degree) / 1e6
        return {"name": name, "amount": f"{len(scene):,} Gaussians, {megabytes:.2f} MB as .ply", "spz": spz}

    def data(self, packed: Sequence[dict[str, str]]) -> dict[str, Any]:
        """Data for ``flight.js``.

        Args:
            packed: what :meth:`packed` gives of one or two scenes; the first is shown on the left.
        """
        fov = 2 * torch.atan(0.5 * max(self.views.width, self.views.height) / self.views.Ks[:, 0, 0].abs())
        return {
            "scenes": list(packed),
            "views": [
                {"eye": eye, "fov": angle, **dict(zip(("right", "down", "ahead"), viewmat[:3], strict=False))}
                for eye, angle, viewmat in zip(
                    _eyes(self.views).tolist(), fov.tolist(), self.views.viewmats[:, :3, :3].tolist(), strict=True
                )
            ],
            "up": self.up.tolist(),
            "near": self.views.near_plane,
            "background": self.views.background.tolist(),
            "antialiased": self.views.rasterize_mode == "antialiased",
            "drag": "look" if self.inside else "orbit",
        }


def _eyes(views: Views) -> Tensor:
    """Positions (C, 3) of cameras."""
    return -(views.viewmats[:, :3, :3].mT @ views.viewmats[:, :3, 3:])[..., 0]


def _in_picture(points: Tensor, views: Views) -> Tensor:
    """Number of points (N, 3) in the picture of each view, (C,); at most a few thousand points are counted."""
    points = points[:: max(1, len(points) // 4096)]
    x, y, z = (views.viewmats[:, :3, :3] @ points.T + views.viewmats[:, :3, 3:]).unbind(1)
    u = x / z * views.Ks[:, 0, :1] + views.Ks[:, 0, 2:]
    v = y / z * views.Ks[:, 1, 1:2] + views.Ks[:, 1, 2:]
    seen = (z > views.near_plane) & (u > 0) & (u < views.width) & (v > 0) & (v < views.height)
    return seen.sum(1)


def _nearest_axis(camera_up: Tensor, estimated: Tensor) -> Tensor:
    """The direction nearest to the mean of the cameras' own ``camera_up`` (3,), as people hold cameras upright: up as
    it is estimated, an axis of the world, or the opposite of one of them."""
    axes = torch.cat([estimated[None], torch.eye(3, dtype=torch.float64)])
    axes = torch.cat([axes, -axes])
    return axes[(axes @ camera_up).argmax()]


def _sampled(scene: Gaussians, centre: Tensor, size: float, up: Tensor) -> Views:
    """Views of a scene that has none: sampled, or else one from outside that shows all of it."""
    try:
        return sample_views(scene, VIEWS, *_SIZE, up=up)
    except DataError:
        lift = math.radians(20.0)
        aside = level_directions(up, torch.zeros(1, dtype=torch.float64))[0]
        eye = centre + 0.8 * size * (math.cos(lift) * aside + math.sin(lift) * up)
        width, height = _SIZE
        K = torch.tensor([[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]], dtype=torch.float64)
        viewmats = look_at(eye[None], centre[None], up)
        return Views(viewmats, K[None], width, height, torch.zeros(3), near_plane=DEFAULTS.near_plane * size)
