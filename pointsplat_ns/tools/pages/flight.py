"""Data of a page to fly through scenes: views, and scenes compressed as SPZ.

Lengths are in units of the content of one scene, so that precision and camera speed do not depend
on the scene's size and position.
"""

from __future__ import annotations

import base64
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import camera_positions
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.pruning import need_usable
from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.view_sampling.content import content_size, in_units, views_in_units
from pointsplat_ns.view_sampling.opening_views import opening_views
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.upright import Up

logger = logging.getLogger("pointsplat_ns")

FLIGHT_SCRIPTS = ("spz.js", "splats.js", "camera.js", "flight.js")
"""Scripts of a page to fly through scenes; they start workers."""


@dataclass(frozen=True, eq=False)
class FlightFrame:
    """Unit of length, up direction and views of a page, shared by all of its scenes."""

    centre: Tensor  # [3] float64, centre of the content, scene units
    size: float  # size of the content, scene units
    up: Up
    views: Views  # in units of the content
    whole: bool
    """Whether the first view shows the whole scene from outside: an object to circle, not a room to
    look around in."""

    @staticmethod
    def of(scene: Gaussians, views: Views | None = None, up: Up | None = None) -> FlightFrame:
        """The frame of a scene and of its smaller versions.

        A flight starts at the known view that shows most, see
        :func:`~pointsplat_ns.view_sampling.opening_views.opening_views`. By default, up is declared
        by the scene, from the views, or estimated. Raises SceneError if no Gaussian can be drawn,
        and DataError if none is visible."""
        need_usable(scene)
        known = None if views is None or len(views) == 0 else views.spread(VIEW_COUNTS.opening)
        if up is None and scene.up is None and known is not None:
            up = _up_of(known, Sampler(scene).up)
        opening = opening_views(scene.detach(), 6, up=up, known=known)
        centre, size = content_size(scene)
        return FlightFrame(
            centre, size, opening.up, views_in_units(opening.views, centre, size), opening.whole
        )

    def encoded(
        self, scene: Gaussians, name: str, progress: Progress = silent, level: int = 6
    ) -> bytes:
        """A scene in units of the content, as SPZ 3. ``level`` is the level of gzip; 6 takes a
        tenth of the time of 9, for 3 % more bytes."""
        placed = in_units(scene.detach(), self.centre.to(scene.device), self.size).to(
            "cpu", torch.float32
        )
        # SPZ stores positions in steps of 1/4096 unit, up to 2047 units. The content's diagonal is
        # 10 units.
        near = placed.usable() & (placed.means.abs() <= 2047.0).all(1)
        left_out = int((~near).sum())
        if left_out:
            logger.warning(
                "%s: %d distant or non-finite Gaussians are left out of the page", name, left_out
            )
        return encode_spz(placed[near], progress, version=3, level=level)

    def packed(self, scene: Gaussians, name: str, progress: Progress = silent) -> dict[str, str]:
        """A scene for the page: name, count, and SPZ data in units of the content as base64."""
        spz = base64.b64encode(self.encoded(scene, name, progress)).decode("ascii")
        return {"name": name, "amount": f"{len(scene):,} Gaussians", "spz": spz}

    def data(self, packed: Sequence[dict[str, str]]) -> dict[str, Any]:
        """Data for ``flight.js`` from results of :meth:`packed` for one or two scenes, the left one
        first."""
        sizes = self.views.size_of_each()
        longer = self.views.Ks.new_tensor([max(size.width, size.height) for size in sizes])
        fov = 2 * torch.atan(0.5 * longer / self.views.Ks[:, 0, 0].abs())
        eyes = camera_positions(self.views.viewmats)
        return {
            "scenes": list(packed),
            "views": [
                {
                    "eye": eye,
                    "fov": angle,
                    "aspect": size.width / size.height,
                    **dict(zip(("right", "down", "ahead"), viewmat[:3], strict=False)),
                }
                for eye, angle, size, viewmat in zip(
                    eyes.tolist(),
                    fov.tolist(),
                    sizes,
                    self.views.viewmats[:, :3, :3].tolist(),
                    strict=True,
                )
            ],
            "up": self.up.direction.tolist(),
            "sure": self.up.sure,
            "near": self.views.near_plane,
            "background": self.views.background.tolist(),
            "antialiased": self.views.rasterize_mode == "antialiased",
            "drag": "orbit" if self.whole else "look",
        }


def _up_of(views: Views, estimated: Up) -> Up:
    """The candidate nearest to the mean up direction of cameras, which people hold upright.
    Candidates are the estimated direction, the world axes, and their opposites. Exactly level
    cameras are not evidence: they were sampled for the estimated direction."""
    viewmats = views.viewmats.double().cpu()
    axes = torch.cat([estimated.direction.cpu()[None], torch.eye(3, **DOUBLES)])
    axes = torch.cat([axes, -axes])
    up = axes[(axes @ -viewmats[:, 1, :3].mean(0)).argmax()]
    return Up(up, estimated.sure or float((viewmats[:, 0, :3] @ up).abs().max()) > 1e-6)
