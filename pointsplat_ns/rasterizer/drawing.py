"""A view of a scene that is projected once and drawn region by region, so that drawing can stop in between."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.blending import Blend, untiled
from pointsplat_ns.rasterizer.constants import QUALITIES, TILE
from pointsplat_ns.rasterizer.projection import project_scene
from pointsplat_ns.rasterizer.rendering import QualityName, finite_colors
from pointsplat_ns.rasterizer.tiles import Footprints, Region
from pointsplat_ns.views import View


class Drawing:
    """One view of a scene, projected. :meth:`draw` gives any part of what :func:`~pointsplat_ns.render` gives, to
    rounding; nothing is differentiable.

    Args:
        scene: N Gaussians, on any device.
        view: the camera.
        quality: thresholds that trade accuracy for speed, as for :func:`~pointsplat_ns.rasterization`.

    Raises:
        ValueError: if the camera is not finite or has no focal length.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> drawing = Drawing(room, ps.sample_views(room, 1, width=64, height=48)[0])
        >>> drawing.rows, drawing.columns, tuple(drawing.draw(Region(0, 2, 0, drawing.columns)).shape)
        (6, 8, (16, 64, 3))
    """

    @torch.no_grad()
    def __init__(self, scene: Gaussians, view: View, quality: QualityName = "exact"):
        seen = project_scene(scene, view)
        seen, self._colors, _ = finite_colors(seen, (scene.features_dc, scene.features_rest), 0, False, scene.sh_degree)
        self._seen = seen
        self._footprints = Footprints(seen, None, 1, view.width, view.height, QUALITIES[quality])
        self.rows, self.columns = self._footprints.rows, self._footprints.columns
        """Number of tiles of 8 pixels along each side."""
        self._width, self._height = view.width, view.height
        self._background = view.background.to(self._colors)

    @torch.no_grad()
    def draw(self, region: Region) -> Tensor:
        """The pixels of a rectangle of tiles, not empty, colours in [0, 1] over the view's background: (h, w, 3), cut
        at the image's edge."""
        seen = self._seen
        image, through = Blend.apply(
            seen.means2d, seen.cov2d, seen.det, seen.opacities, self._colors, self._footprints, region, False,
            None, None,
        )  # fmt: skip
        height = min(region.bottom * TILE, self._height) - region.top * TILE
        width = min(region.right * TILE, self._width) - region.left * TILE
        color, left = (untiled(values, region)[0, :height, :width] for values in (image, through))
        return (color + left * self._background).clamp_(0, 1)
