"""Camera paths written by hand: what a visitor of a scene would look at.

A path is a JSON file of the scene's name in ``lab/judge/paths``. Neither the package's sampler of views nor its
estimate of up had a part in them, so that they can judge what these lead to.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import replacing
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views

FOLDER = Path(__file__).parent / "paths"
"""Where the paths are."""

ASPECT = (16, 9)
"""Shape of every picture: that of screens."""

NEAR_PLANE = 1e-3
"""Depth that views start at, as a share of the median distance between the eye and what it looks at."""

FIELDS_OF_VIEW = (20.0, 120.0)
"""Degrees across the width that a path may ask for; beyond these it is more likely a mistake."""

SHEET = 320, 4
"""Width of a picture on a contact sheet, pixels, and pictures in a row."""


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
    if not path.is_file():
        raise SystemExit(f"{path}: no such file; expected a camera path for {path.stem}")
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise SystemExit(f"{path}: cannot be read as JSON ({error}); expected a camera path") from error
    if not isinstance(content, dict):
        raise SystemExit(f"{path}: found {type(content).__name__}; expected an object with scene, up, views")
    for name in ("scene", "about"):
        if not isinstance(content.get(name), str) or not content[name]:
            raise SystemExit(f"{path}: {name} is {content.get(name)!r}; expected text")
    if content["scene"] != path.stem:
        raise SystemExit(f"{path}: scene is {content['scene']!r}; expected the name of the file, {path.stem!r}")
    fov = content.get("field_of_view")
    if not _is_number(fov) or not FIELDS_OF_VIEW[0] <= fov <= FIELDS_OF_VIEW[1]:
        low, high = FIELDS_OF_VIEW
        raise SystemExit(f"{path}: field_of_view is {fov!r}; expected degrees from {low:g} to {high:g}")
    up = _vector(path, "up", content.get("up"))
    if not bool(up.any()):
        raise SystemExit(f"{path}: up is {content['up']}; expected a direction")
    views = content.get("views")
    if not isinstance(views, list) or not views:
        raise SystemExit(f"{path}: views is {views!r}; expected a list of eye and at")
    ends: dict[str, list[Tensor]] = {"eye": [], "at": []}
    for number, view in enumerate(views):
        for name, found in ends.items():
            value = view.get(name) if isinstance(view, dict) else None
            found.append(_vector(path, f"{name} of view {number}", value))
        if torch.equal(ends["eye"][-1], ends["at"][-1]):
            raise SystemExit(f"{path}: view {number} looks at its own eye, {view['eye']}; expected two places")
    return CameraPath(content["scene"], content["about"], up, fov, torch.stack(ends["eye"]), torch.stack(ends["at"]))


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
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    near = NEAR_PLANE * float((found.ats - found.eyes).norm(dim=1).median())
    return Views(viewmats, K.repeat(len(viewmats), 1, 1), width, height, torch.zeros(3), near_plane=near)


@torch.no_grad()
def write_sheet(scene: Gaussians, path: Path, target: Path) -> None:
    """Draw all views of a path, small, as one PNG.

    Args:
        scene: the scene of the path.
        path: the JSON file of the path.
        target: the PNG to write.

    Raises:
        SystemExit: if the file is not a path.
    """
    width, across = SHEET
    views = views_of(path, width)
    rows = math.ceil(len(views) / across)
    sheet = Image.new("RGB", (across * views.width, rows * views.height))
    draw = ImageDraw.Draw(sheet)
    for number, view in enumerate(views):
        corner = (number % across * views.width, number // across * views.height)
        pixels = (255 * render(scene, view)).round().to(torch.uint8).numpy()
        sheet.paste(Image.fromarray(pixels), corner)
        draw.text((corner[0] + 3, corner[1] + 2), str(number), fill=(255, 255, 0))
    with replacing(target) as part:
        sheet.save(part, format="PNG")


def _vector(path: Path, name: str, value: Any) -> Tensor:
    """Three finite numbers, (3,) float64."""
    if not (isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))):
        raise SystemExit(f"{path}: {name} is {value!r}; expected three finite numbers")
    return torch.tensor(value, dtype=torch.float64)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
