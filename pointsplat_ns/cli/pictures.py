"""Pictures side by side, with captions."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike


def side_by_side(rows: list[list[ArrayLike]], titles: list[str], path: Path) -> None:
    """Draw a grid of images of one size, a title above each column.

    Args:
        rows: images (H, W, 3) in [0, 1], as many in each row as there are titles.
        titles: of the columns.
        path: the PNG to write.

    Raises:
        SceneError: if it cannot be written.
    """
    import numpy as np
    from matplotlib.figure import Figure

    from pointsplat_ns.io.files import replacing

    height, width = np.shape(rows[0][0])[:2]
    panel = 16 / max(len(titles), 3)  # inches across
    size = (panel * len(titles), panel * len(rows) * height / width + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for row, images in zip(axes, rows, strict=True):
        for axis, image in zip(row, images, strict=True):
            axis.imshow(np.asarray(image))
            axis.set_axis_off()
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=11)
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png")
