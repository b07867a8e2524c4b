"""Draws scenes side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.pipeline.cleaning import clusters
from pointsplat_ns.pipeline.quality import Quality
from pointsplat_ns.pipeline.report import Report
from pointsplat_ns.pipeline.run import Cleaned
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.rendering import render, render_with_alpha
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import spread_indices
from pointsplat_ns.system.files import replacing
from pointsplat_ns.tools.wording import STAGES, origin_text, quality_lines, views_of_size


@torch.no_grad()
def plot_comparison(
    dense: Gaussians,
    result: Report,
    path: Path | str,
    files: Sequence[str] = ("", ""),
    quality: Quality | None = None,
) -> str:
    """Draw the dense scene and the scene after each stage side by side, in three views.

    Args:
        dense: the scene that was compacted.
        result: the result of :func:`pointsplat_ns.compact`.
        path: the PNG file to write.
        files: titles of the dense scene and the result, such as "room.ply, 7.42 MB".
        quality: quality of the result's file, for its title.

    Returns:
        A line of text: the columns of the image, or the reason why nothing is drawn.

    Raises:
        SceneError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 2, width=64, height=48)
        >>> result = ps.compact(room, keep=500, views=views, effort="instant")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(ps.plot_comparison(room, result, f"{folder}/shown.png").endswith("side by side"))
        True
    """
    if result.reference is None:
        return f"{path}: not drawn, because there are no views"
    views = result.reference.views
    renders = result.reference.renders
    shown = spread_indices(len(views), 3)
    names = ["dense"]
    titles = [_title("dense", dense, files[0])]
    scenes = []
    for stage in result.stages:
        if stage.after is not None:
            done = STAGES[stage.stage]
            names.append(done if stage.accepted else f"{done} (rejected)")
            last = stage is result.last
            lines: tuple[str, ...] = ()
            if last:
                lines = (files[1], *(() if quality is None else quality_lines(quality)))
            titles.append(_title(names[-1], stage.scene, *lines))
            scenes.append(stage.scene)
    rows = [[renders[i].cpu(), *(render(scene, views[i]).cpu() for scene in scenes)] for i in shown]
    side_by_side(rows, titles, path)
    return f"{path}: {', '.join(names)}, side by side"


def _title(name: str, scene: Gaussians, *lines: str) -> str:
    return "\n".join([name, f"{len(scene):,} Gaussians", *lines])


@torch.no_grad()
def plot_views(dense: Gaussians, source: ViewProvider, path: Path | str) -> str:
    """Draw up to 16 of the views used for decisions on a scene, as a sheet of four columns.

    Args:
        dense: N Gaussians on the CPU.
        source: source of views.
        path: the PNG file to write.

    Returns:
        A line of text: number, size and origin of the views.

    Raises:
        DataError: if there are no views.
        SceneError: if the file cannot be written.
    """
    views = source.views(VIEW_COUNTS.weighed)
    columns = 4
    pictures = [render(dense, view) for view in views.spread(columns**2).resized(320)]
    rows = [pictures[first : first + columns] for first in range(0, len(pictures), columns)]
    rows[-1] += [torch.ones_like(pictures[0])] * (columns - len(rows[-1]))
    side_by_side(rows, [""] * columns, path)
    return f"{path}: {len(pictures)} of {views_of_size(views)}; {origin_text(source.origin)}"


@torch.no_grad()
def plot_cleaning(done: Cleaned, path: Path | str) -> None:
    """Draw the three views with the most removed pixels: the dense scene; the removed Gaussians
    over the scene in grey, with a colour per cluster for the ten largest; and the cleaned scene."""
    from matplotlib import colormaps

    dense = done.dense
    cleaned = done.scene
    views = done.views.scored(VIEW_COUNTS.scored)
    removed = dense[done.cleaning.junk.first(len(dense) - 1).indices.to(dense.device)]
    removed = removed[removed.usable()]
    colors = torch.from_numpy(colormaps["tab10"](np.arange(10))[:, :3])[
        clusters(removed).clamp_max(9)
    ]
    marked = removed.replace(
        features_dc=((colors - 0.5) / SH_C0).to(removed.means),
        features_rest=torch.zeros_like(removed.features_rest),
    )
    views = dataclasses.replace(views, background=torch.zeros_like(views.background))
    shares = torch.stack([render_with_alpha(marked, view)[1].sum() for view in views])
    rows = []
    for view in views[shares.argsort(descending=True, stable=True)[:3].cpu()]:
        before = render(dense, view)
        over, alpha = render_with_alpha(marked, view)
        grey = 0.2 + 0.5 * before.mean(-1, keepdim=True).expand_as(before)
        rows.append([before.cpu(), (over + (1 - alpha) * grey).cpu(), render(cleaned, view).cpu()])
    titles = [
        f"{len(dense):,} Gaussians",
        f"{len(dense) - len(cleaned):,} removed",
        f"{len(cleaned):,} remain",
    ]
    side_by_side(rows, titles, path)


def side_by_side(rows: Sequence[Sequence[ArrayLike]], titles: list[str], path: Path | str) -> None:
    """Draw a grid of images (H, W, 3) in [0, 1] to a PNG file. Cells have the shape of the tallest
    image. Titles stand above the columns and in the file's description. Raises SceneError if the
    file cannot be written."""
    from matplotlib.figure import Figure

    shapes = [np.shape(image)[:2] for images in rows for image in images]
    height, width = max(shapes, key=lambda shape: shape[0] / shape[1])
    panel = 16 / max(len(titles), 3)  # inches across
    size = (panel * len(titles), panel * len(rows) * height / width + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for row, images in zip(axes, rows, strict=True):
        for axis, image in zip(row, images, strict=True):
            axis.imshow(np.asarray(image))
            axis.set_axis_off()
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=11)
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png", metadata={"Description": "\n".join(titles)})
