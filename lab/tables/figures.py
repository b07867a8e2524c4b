"""Draws the paper's Figures 1, 3, 4 and 5 of your scenes.

python -m lab.tables.figures 3 RUN -o figure3.png --refiners networks
python -m lab.tables.figures 4 tables -o figure4.png
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from lab.common.printing import percent, save_figure, start
from lab.tables.cells import Tables
from lab.tables.figure import plot_figure
from lab.tables.make_scene import Maker, Refiners, Tools
from lab.tables.scenes import Options, open_scene, scenes_at
from lab.tables.ways import PROTOCOL, WAYS
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians

FEW = PROTOCOL.ablation_share
HALF = PROTOCOL.figure_share
COLUMNS = {
    1: ((WAYS.paper, FEW), (WAYS.pointsplat, FEW)),
    3: ((WAYS.dense, 1.0), (WAYS.splatformer, HALF), (WAYS.pointsplat, HALF)),
    5: ((WAYS.dense, 1.0), *((way, FEW) for _, way in WAYS.table_3 if way.network is None)),
}
"""Ways and shares side by side, by the number of the figure. The paper does not say the share of
Figures 1 and 5."""


def solid(scene: Gaussians) -> Gaussians:
    """The Gaussians as opaque ellipsoids of half their size, so that each is seen."""
    opacities = torch.full_like(scene.opacities, 9.0)
    return scene.replace(opacities=opacities, scales=scene.scales - math.log(2))


@torch.no_grad()
def main(
    number: tyro.conf.Positional[Literal[1, 3, 4, 5]],
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    refiners: tuple[Path, ...] = (),
    view: int = 0,
    views: int = 10,
    side: int = 640,
    data: Path | None = None,
) -> None:
    """Draw one of the paper's figures.

    Args:
        number: 1: selected and refined Gaussians, in a picture and as ellipsoids. 3: photo, dense
            scene, SplatFormer and PointSplat. 4: opacity and volume. 5: selections at five lambdas.
        scenes: as for ``python -m lab.tables``; for Figure 4 its output folder.
        output: a picture, such as figure3.png.
        refiners: weights, as for ``python -m lab.tables``.
        view: which of the held-out views is shown.
        views: largest number of held-out views.
        side: largest side of a picture, pixels.
        data: as for ``python -m lab.tables``.
    """
    from matplotlib.figure import Figure

    if number == 4:
        tables = Tables.read(scenes[0])
        return plot_figure(tables.cells, tables.groups(), output)
    tools = Tools(Options(views, side, fine_tune=300), Refiners(refiners))
    rows = []
    for name, path in (pair for given in scenes for pair in scenes_at(given).items()):
        scene = open_scene(path, data, tools.options)
        maker = Maker(scene, name, tools)
        look = scene.held_out.views[view]
        made = {}
        for way, share in COLUMNS[number]:
            if why := tools.missing(way, share, maker.name):
                raise PointSplatError(f"{maker.name}: {way.label} cannot be drawn: {why}")
            label = f"{way.label}, {percent(share)}"
            label += "" if way.opacity_weight is None else f", lambda {way.opacity_weight:g}"
            made[label] = maker.make(way, share).scenes[0]
        photo = (
            {"photo": scene.held_out.photos[view]} if number == 3 and scene.held_out.photos else {}
        )
        rows.append(photo | {label: render(small, look) for label, small in made.items()})
        if number != 3:
            rows.append(
                {
                    f"{label}: ellipsoids": render(solid(small), look)
                    for label, small in made.items()
                }
            )
    columns = max(map(len, rows))
    high = 3.2 * look.height / look.width + 0.3
    figure = Figure(figsize=(3.2 * columns, high * len(rows)), layout="constrained")
    for axis in (axes := figure.subplots(len(rows), columns, squeeze=False)).flat:
        axis.set_axis_off()
    for row, line in zip(rows, axes, strict=True):
        for (label, image), axis in zip(row.items(), line, strict=False):
            axis.imshow(image.clamp(0, 1).cpu().numpy())
            axis.set_title(label, fontsize=8)
    save_figure(figure, output)


if __name__ == "__main__":
    start(main)
