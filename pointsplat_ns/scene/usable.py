"""Removes Gaussians that cannot be drawn, when scenes are read and written."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.files import logger


def keep_usable(scene: Gaussians, path: Path | str) -> Gaussians:
    """``scene`` without infinite values and without the Gaussians that cannot be drawn, whose
    number is logged.

    Drawable Gaussians may have opacity logits of +-Inf (opacity 1 and 0) and log-scales of -Inf (a
    flat axis), see :meth:`~pointsplat_ns.scene.gaussians.Gaussians.usable`. These become +-30 and
    -87, which draw the same in float32.
    """
    usable = usable_part(scene)
    dropped = len(scene) - len(usable)
    if dropped:
        logger.warning(
            "%s: dropped %d of %d Gaussians with NaN or infinite values", path, dropped, len(scene)
        )
    return usable


def usable_part(scene: Gaussians) -> Gaussians:
    """As :func:`keep_usable`, but without logging."""
    usable = scene.usable()
    if not bool(usable.all()):
        scene = scene[usable]
    if bool(scene.opacities.isinf().any()) or bool(scene.scales.isinf().any()):
        opacities = scene.opacities.nan_to_num(posinf=30.0, neginf=-30.0)
        scene = scene.replace(opacities=opacities, scales=scene.scales.nan_to_num(neginf=-87.0))
    return scene
