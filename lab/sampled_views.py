"""Draws docs/concepts/sampled.jpg: the room that ships from above with twelve sampled cameras, and
what they see.

    python -m lab.sampled_views docs/concepts/sampled.jpg
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import torch
import tyro
from matplotlib.patheffects import withStroke

import pointsplat_ns as ps
from lab.common.printing import save_figure, start
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import camera_positions
from pointsplat_ns.pruning.merging.covariance import plane_axes
from pointsplat_ns.view_sampling.sampler import Sampler

VIEWS = 12

SIZE = (320, 240)
"""Of a picture, pixels."""

CEILING = 0.75
"""Share of the Gaussians, lowest first, that the plan shows."""

RED = "crimson"

LABEL = {
    "color": RED,
    "fontsize": 11,
    "fontweight": "bold",
    "path_effects": [withStroke(linewidth=3, foreground="white")],
}
"""Of numbers on the plan."""


@torch.no_grad()
def main(target: tyro.conf.Positional[Path] = Path("docs/concepts/sampled.jpg")) -> None:
    """Draw the picture.

    Args:
        target: the picture to write.
    """
    room = ps.example_room()
    views = ps.sample_views(room, VIEWS, *SIZE)
    places = camera_positions(views.viewmats).double()
    up = Sampler(room).up.direction.double()
    plan = torch.stack([axis[0] for axis in plane_axes(up[None])], dim=1)

    figure = plt.figure(figsize=(12, 4.4), layout="constrained")
    left, others = figure.subfigures(1, 2, width_ratios=(0.36, 0.64))
    above = left.subplots()
    means = room.means.double()
    heights = means @ up
    shown = (heights < heights.quantile(CEILING)) & (room.alphas > 0.5)
    colours = (0.5 + SH_C0 * room.features_dc).clamp(0, 1)
    flat = means[shown] @ plan
    above.scatter(*flat.T, s=0.4, c=colours[shown].numpy())
    length = 0.08 * float((flat.amax(dim=0) - flat.amin(dim=0)).max())
    for number, (view, axes) in enumerate(zip(views, others.subplots(3, 4).flat, strict=True), 1):
        place = places[number - 1] @ plan
        ahead = view.viewmat[2, :3].double() @ plan
        ahead = length * ahead / ahead.norm()
        above.arrow(*place, *ahead, width=0.06 * length, color=RED, length_includes_head=True)
        aside = 0.4 * (number % 5 - 2) * torch.stack([-ahead[1], ahead[0]])  # apart from others
        above.text(*(place - 0.5 * ahead + aside), str(number), **LABEL)
        axes.imshow(ps.render(room, view).clamp(0, 1).numpy())
        axes.set_title(str(number), color=RED, fontsize=10, pad=2)
        axes.set_axis_off()
    above.set_title("the room from above, and twelve cameras", fontsize=11)
    above.set_aspect("equal")
    above.set_axis_off()
    save_figure(figure, target, dpi=100, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    start(main)
