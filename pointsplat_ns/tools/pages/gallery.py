"""Draws galleries of scenes before and after: a page, and one picture.

Both are made from pairs of pictures, which lie beside the results.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import torch

from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import write_picture
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.files import bytes_text, replacing
from pointsplat_ns.system.outputs import is_own_file
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.tools.pages.flight import FlightFrame
from pointsplat_ns.tools.pages.html import page
from pointsplat_ns.tools.pages.image_encoding import picture_uri, read_png, with_labels
from pointsplat_ns.view_sampling.content import in_units

if TYPE_CHECKING:
    from pointsplat_ns.tools.folders import SceneResult

WIDTH = 640
HEIGHT = 400
"""Size of one picture of a pair, pixels."""


def pair_of(output: Path) -> Path:
    """File with the pair of pictures of a result."""
    return output.with_name(f"{output.name}.png")


@torch.no_grad()
def draw_pair(before: Gaussians, after: Gaussians, known: Views | None, path: Path) -> None:
    """Draw a scene before and after side by side, to an automatically named PNG file, in the first
    view of its page. ``known`` are its views, if any. Raises DataError if nothing of the scene is
    visible, and SceneError if the file cannot be written."""
    frame = FlightFrame.of(before, known)
    first = frame.views[:1].resized(WIDTH)
    view = first.resized(round(max(first.width, first.height) * min(1.0, HEIGHT / first.height)))[0]
    pair = torch.zeros(HEIGHT, 2 * WIDTH, 3, **FLOATS)
    top = (HEIGHT - view.height) // 2
    left = (WIDTH - view.width) // 2
    for start, scene in ((left, before), (left + WIDTH, after)):
        drawn = render(in_units(scene, frame.centre.to(scene.device), frame.size), view)
        pair[top : top + view.height, start : start + view.width] = drawn.cpu()
    write_picture(pair, path, named=False)


def write_gallery(path: Path, title: str, results: Sequence[SceneResult]) -> None:
    """Write a page of all scenes before and after, with links to their files. Failed and unfinished
    scenes are listed. Raises SceneError if the page cannot be written."""
    scenes = [_facts(result, path) for result in results]
    done = [result for result in results if result.megabytes is not None]
    sizes = [
        sum(result.megabytes_before or 0.0 for result in done),
        sum(result.megabytes or 0.0 for result in done),
    ]
    html = page(
        "gallery.html",
        title=title,
        scenes=scenes,
        done=len(done),
        width=2 * WIDTH,
        height=HEIGHT,
        sizes=[bytes_text(1e6 * size) for size in sizes],
    )
    with replacing(path) as part:
        part.write_bytes(html)


def write_sheet(path: Path, results: Sequence[SceneResult]) -> None:
    """Write one PNG file with all existing pairs of pictures, with names and sizes. Raises
    SceneError if it cannot be written."""
    drawn = [result for result in results if _pair(result) is not None]
    columns = max(1, math.ceil(math.sqrt(len(drawn) / 3)))
    # At most 40 million pixels.
    step = max(1, math.ceil(math.sqrt(len(drawn) * 2 * WIDTH * HEIGHT / 40e6)))
    height = HEIGHT // step
    width = 2 * WIDTH // step
    sheet = np.full(
        (max(1, math.ceil(len(drawn) / columns)) * height, columns * width, 3), 255, np.uint8
    )
    for index, result in enumerate(drawn):
        pair = _pair(result)
        if pair is None:  # removed meanwhile
            continue
        before, after = _sizes(result)
        row, column = divmod(index, columns)
        small = pair[: height * step : step, ::step][:, :width]
        labelled = with_labels(small, (f"{result.name}: {before}", after))
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = labelled
    write_picture(torch.from_numpy(sheet) / 255, path)


def _pair(result: SceneResult) -> np.ndarray | None:
    """Pair of pictures (H, 2 W, 3) uint8 of a result; None if it is missing or damaged."""
    path = pair_of(Path(result.output))
    if result.megabytes is None or not is_own_file(path):
        return None
    return read_png(path, 2 * WIDTH, HEIGHT)


def _sizes(result: SceneResult) -> tuple[str, str]:
    """Count and size before and after. An edited record may lack them."""
    known = (result.before, result.megabytes_before), (result.after, result.megabytes)
    before, after = (
        f"{count or 0:,} Gaussians, {bytes_text(1e6 * (size or 0.0))}" for count, size in known
    )
    return before, after


def _facts(result: SceneResult, path: Path) -> dict[str, Any]:
    """Entry of a scene in the page at ``path``."""
    finished = result.megabytes is not None
    pair = _pair(result)
    text = str(result) if finished else result.error or "not finished"
    link = quote(Path(os.path.relpath(result.output, path.parent)).as_posix()) if finished else ""
    return {
        "name": result.name,
        "file": Path(result.output).name,
        "link": link,
        "sizes": _sizes(result),
        "picture": None if pair is None else picture_uri(pair),
        "failed": bool(result.error),
        "text": text,
    }
