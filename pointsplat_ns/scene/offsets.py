"""Offsets of scenes far from their origin, such as geo-referenced ones, to preserve precision."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pointsplat_ns.scene.gaussians import Gaussians, Offset
from pointsplat_ns.system.files import logger
from pointsplat_ns.system.tensors import DOUBLES

SAMPLED = 4096
"""Maximum number of Gaussians sampled to estimate the distance and size of a scene."""


def offset_for(means: NDArray[np.float64], log_scales: NDArray[np.floating]) -> Offset | None:
    """The offset for a scene whose positions lose too much precision in float32; None if they do
    not.

    It is the median position, rounded to a power of ten within the extent of the scene.

    Args:
        means: (N, 3) positions, scene units.
        log_scales: (N, 2) or (N, 3) natural logarithms of standard deviations in scene units.
    """
    usable = np.isfinite(means).all(axis=1) & np.isfinite(log_scales).all(axis=1)
    if not usable.any() or _steps_a_size(means[usable], log_scales[usable]) <= 1 / 32:
        return None
    return rounded_centre(means[usable])


def rounded_centre(means: NDArray[np.float64]) -> Offset:
    """Median of finite positions (N, 3), N > 0, rounded to a power of ten within their extent."""
    centre = np.median(means, axis=0)
    extent = float(np.median(np.abs(means - centre).max(axis=1)))
    unit = 10.0 ** math.floor(math.log10(extent)) if extent > 1e-300 else 0.0
    x, y, z = (np.rint(centre / unit) * unit if unit else centre).tolist()
    return x, y, z


def warn_if_far(scene: Gaussians, path: Path | str) -> None:
    """Log a warning if a scene's positions have lost precision: float32 steps are large compared to
    the sizes of Gaussians."""
    some = scene[:: max(1, len(scene) // SAMPLED)]
    if not len(some):
        return
    means = some.means.detach().double().cpu().numpy()
    times = _steps_a_size(means, some.scales.detach().double().cpu().numpy())
    if times > 1 / 4:
        logger.warning(
            "%s: lies %.3g units from its origin, where float32 steps are %.2g times the median "
            "size of a Gaussian: positions have lost precision; export it with x, y and z as "
            "doubles, or nearer to the origin",
            path,
            np.abs(np.median(means, axis=0)).max(),
            times,
        )


OFFSET_COMMENT = "Offset: "
"""Begins the comment, of a PLY or a RAD, that holds an offset as text."""


def offset_text(offset: Offset) -> str:
    """An offset as text, such as ``451000.0 5411000.0 300.0``, exact to the bit."""
    return " ".join(repr(value) for value in offset)


def offset_of_text(text: str) -> Offset | None:
    """The offset in a text of :func:`offset_text`; None for any other text."""
    try:
        x, y, z = (float(word) for word in text.split())
    except ValueError:
        return None
    # Beyond 1e15, doubles have steps of a tenth.
    return (x, y, z) if all(abs(value) < 1e15 for value in (x, y, z)) else None


def from_centre(scene: Gaussians) -> Gaussians:
    """A scene with the offset :func:`rounded_centre`, in the frame of its file."""
    usable = scene.means[scene.usable()].double().cpu()
    if not len(usable):
        return scene
    before = scene.offset or (0.0, 0.0, 0.0)
    x, y, z = rounded_centre((usable + torch.tensor(before, **DOUBLES)).numpy())
    return scene.at_offset((x, y, z))


def _steps_a_size(means: NDArray[np.float64], log_scales: NDArray[np.floating]) -> float:
    """Float32 step at the median position, relative to the median size of the Gaussians."""
    step = float(np.abs(np.median(means, axis=0)).max()) * 2.0**-23
    size = math.exp(min(max(float(np.median(np.median(log_scales, axis=1))), -300.0), 300.0))
    return step / size
