"""The data of a page that flies through scenes: views, and scenes compressed as SPZ.

Lengths are in units of the content of one scene, so that precision and camera speed do not depend on the scene's size
and position.
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
from pointsplat_ns.looking.poses import in_pictures, look_at
from pointsplat_ns.looking.sampling import estimated_up, sample_views
from pointsplat_ns.looking.settings import AROUND, DEFAULTS
from pointsplat_ns.looking.upright import level_directions
from pointsplat_ns.pruning import need_usable, ply_bytes
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.views import Views

logger = logging.getLogger("pointsplat_ns")

SCRIPTS = ("spz.js", "splats.js", "camera.js", "flight.js")
"""Scripts of a flight, for :func:`~pointsplat_ns.pages.html.page` with ``with_workers``."""

VIEWS = 6
"""Maximum number of views in a page."""

MAX_COORDINATE = 2047.0
"""Largest coordinate of a Gaussian in a page, in units of the content (10 to its diagonal); farther ones are left out.
Positions in SPZ have steps of 1/4096 of a unit up to there."""


@dataclass(frozen=True, eq=False)
class FlightFrame:
    """The unit of length, the up direction and the views of a page, common to all of its scenes."""

    centre: Tensor  # [3] float64, centre of the content, scene units
    size: float  # size of the content, scene units
    up: Tensor  # [3] float64
    views: Views  # in units of the content
    inside: bool
    """Whether the first camera is inside the content: a room to look around in, not an object to orbit."""

    @staticmethod
    def of(scene: Gaussians, views: Views | None = None) -> FlightFrame:
        """The frame of a scene, which also suits smaller versions of it.

        Args:
            scene: N Gaussians.
            views: at most :data:`VIEWS` of them are used; by default they are sampled. A flight starts at the view with
                most Gaussians in its picture.

        Raises:
            SceneError: if no Gaussian can be drawn.
            DataError: if no Gaussian is visible.
        """
        need_usable(scene)
        low, high = content_box(scene)
        centre, size = content_size(scene, (low, high))
        up = estimated_up(scene).direction.cpu()
        if views is None or len(views) == 0:
            views = _sampled(scene, centre, size, up)
        views = views_in_units(views.spread(VIEWS), centre, size)
        some = positions_in_units(scene.means[:: max(1, len(scene) // 4096)], centre, size).cpu()
        counts = in_pictures(views, some, views.near_plane).sum(1)
        views = views[counts.argsort(descending=True, stable=True)]
        up = _nearest_axis(-views.viewmats[:, 1, :3].double().mean(0), up)
        half = positions_in_units(high, centre, size).cpu().abs()
        return FlightFrame(centre, size, up, views, bool((_eyes(views)[0].abs() < half).all()))

    def packed(self, scene: Gaussians, name: str, progress: Progress = silent) -> dict[str, str]:
        """A scene for the page: its name, text on its size, and its data in units of the content as base64 of SPZ 3.

        Args:
            scene: N Gaussians.
            name: name in the page.
            progress: called while compressing.
        """
        placed = in_units(scene.detach(), self.centre.to(scene.device), self.size).to("cpu", torch.float32)
        near = placed.usable() & (placed.means.abs() <= MAX_COORDINATE).all(1)
        left_out = int((~near).sum())
        if left_out:
            logger.warning("%s: %d Gaussians, very far away or not finite, are not in the page", name, left_out)
        # A tenth of the time of level 9, for 3 % more bytes.
        spz = base64.b64encode(encode_spz(placed[near], progress, level=6)).decode("ascii")
        megabytes = ply_bytes(len(scene), scene.sh_degree) / 1e6
        return {"name": name, "amount": f"{len(scene):,} Gaussians, {megabytes:.2f} MB as .ply", "spz": spz}

    def data(self, packed: Sequence[dict[str, str]]) -> dict[str, Any]:
        """Data for ``flight.js``.

        Args:
            packed: results of :meth:`packed` for one or two scenes; the first is on the left.
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


def _nearest_axis(camera_up: Tensor, estimated: Tensor) -> Tensor:
    """The candidate nearest to ``camera_up`` (3,), the mean up direction of the cameras, which people hold upright.
    Candidates are the estimated up direction, the world axes, and their opposites."""
    axes = torch.cat([estimated[None], torch.eye(3, dtype=torch.float64)])
    axes = torch.cat([axes, -axes])
    return axes[(axes @ camera_up).argmax()]


def _sampled(scene: Gaussians, centre: Tensor, size: float, up: Tensor) -> Views:
    """Sampled views of a scene, of the size of the page; where sampling fails, one from outside that shows all of
    it."""
    width, height = 960, 600
    try:
        return sample_views(scene, VIEWS, width, height, up=up, settings=AROUND)
    except DataError:
        lift = math.radians(20.0)
        aside = level_directions(up, torch.zeros(1, dtype=torch.float64))[0]
        eye = centre + 0.8 * size * (math.cos(lift) * aside + math.sin(lift) * up)
        K = torch.tensor([[0.7 * width, 0, width / 2], [0, 0.7 * width, height / 2], [0, 0, 1]], dtype=torch.float64)
        viewmats = look_at(eye[None], centre[None], up)
        return Views(viewmats, K[None], width, height, torch.zeros(3), near_plane=DEFAULTS.near_plane * size)
