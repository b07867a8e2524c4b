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
from lab.common.printing import start
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.system.files import replacing

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
    up = torch.stack([-view.viewmat[1, :3] for view in views]).mean(dim=0).double()
    up = up / up.norm()
    right = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype)[up.abs().argmin()])
    right = right / right.norm()
    plan = torch.stack([right, torch.linalg.cross(up, right)], dim=1)

    figure = plt.figure(figsize=(12, 4.4), layout="constrained")
    left, others = figure.subfigures(1, 2, width_ratios=(0.36, 0.64))
    above = left.subplots()
    means = room.means.double()
    heights = means @ up
    shown = (heights < heights.quantile(CEILING)) & (room.alphas > 0.5)
    colours = (0.5 + SH_C0 * room.features_dc.reshape(len(room), 3)).clamp(0, 1)
    above.scatter(*(means[shown] @ plan).T, s=0.4, c=colours[shown].numpy())
    bounds = (means[shown] @ plan).quantile(torch.tensor([0.0, 1.0], dtype=up.dtype), dim=0)
    length = 0.08 * float((bounds[1] - bounds[0]).max())
    for number, (view, axes) in enumerate(zip(views, others.subplots(3, 4).flat, strict=True), 1):
        matrix = view.viewmat.double()
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
        place = (-rotation.T @ translation) @ plan
        ahead = rotation[2] @ plan
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
    with replacing(target) as part:
        figure.savefig(part, format="jpg", dpi=100, pil_kwargs={"quality": 88})
    plt.close(figure)
    print(target)


if __name__ == "__main__":
    start(main)
