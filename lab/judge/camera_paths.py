"""Camera paths written by hand: what a visitor of a scene would look at.

A path is a JSON file of the scene's name in ``lab/judge/paths``. Neither the package's sampler of
views nor its estimate of up had a part in them, so that they can judge what these lead to.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.poses import look_at

FOLDER = Path(__file__).parent / "paths"
"""Where the paths are."""

ASPECT = (16, 9)
"""Shape of every picture: that of screens."""

NEAR_PLANE = 1e-3
"""Depth that views start at, as a share of the median distance between the eye and what it looks
at."""

FIELDS_OF_VIEW = (20.0, 120.0)
"""Degrees across the width that a path may ask for; beyond these it is more likely a mistake."""


@dataclass(frozen=True)
class CameraPath:
    """Views of a scene, in its own coordinates."""

    scene: str
    about: str
    up: Tensor  # [3]
    field_of_view: float  # degrees across the width
    eyes: Tensor  # [C, 3]
    ats: Tensor  # [C, 3] what they look at


def path_of(scene: str) -> Path:
    """The file of a scene's path, which may not exist."""
    return FOLDER / f"{scene}.json"


def read_path(path: Path) -> CameraPath:
    """Read a path.

    Raises:
        SystemExit: if the file cannot be read, or is not a path.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
        eyes, ats = (_vectors([view[end] for view in content["views"]]) for end in ("eye", "at"))
        found = CameraPath(
            content["scene"], content["about"], _vectors([content["up"]])[0], 0.0, eyes, ats
        )
        found = replace(found, field_of_view=float(content["field_of_view"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SystemExit(
            f"{path}: not a camera path of {path.stem} ({error!r}); expected scene, about, up, "
            "field_of_view, and views of eye and at"
        ) from error
    low, high = FIELDS_OF_VIEW
    wrong = {
        f"scene is {found.scene!r}": found.scene != path.stem,
        f"field_of_view is {found.field_of_view:g}, not from {low:g} to {high:g}": not low
        <= found.field_of_view
        <= high,
        "up has no direction": not bool(found.up.any()),
        "a view looks at its own eye": bool((found.eyes == found.ats).all(1).any()),
    }
    if any(wrong.values()):
        raise SystemExit(f"{path}: {', '.join(what for what, so in wrong.items() if so)}")
    return found


def _vectors(values: list[list[float]]) -> Tensor:
    """Finite vectors, (C, 3) float64. Raises ValueError or TypeError if they are none."""
    found = torch.tensor(values, dtype=torch.float64)
    if found.ndim != 2 or found.shape[1] != 3 or not len(found) or not bool(found.isfinite().all()):
        raise ValueError(
            f"vectors of shape {tuple(found.shape)}; expected three finite numbers each"
        )
    return found


def views_of(path: Path, width: int) -> Views:
    """The views of a path, over black.

    Args:
        path: the JSON file.
        width: of the pictures, pixels; the height is 9/16 of it.

    Raises:
        SystemExit: if the file is not a path, or the width has no height.
    """
    found = read_path(path)
    height = width * ASPECT[1] // ASPECT[0]
    if height < 1:
        raise SystemExit(f"pictures of a width of {width} asked for; expected at least 2 pixels")
    viewmats = look_at(found.eyes, found.ats, found.up)
    focal = 0.5 * width / math.tan(math.radians(found.field_of_view) / 2)
    K = torch.tensor(
        [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    near = NEAR_PLANE * float((found.ats - found.eyes).norm(dim=1).median())
    return Views(
        viewmats, K.repeat(len(viewmats), 1, 1), width, height, torch.zeros(3), near_plane=near
    )
