"""Intrinsics of a scene in NICE-SLAM's Replica layout: ``cam_params.json``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import one_line, read_text

FARTHEST = 1e18
"""Poses with larger numbers count as lost tracking: float32, in which scenes are trained, cannot square them."""

PixelCenters = Literal["auto", "integer", "half"]


@dataclass(frozen=True)
class PinholeParams:
    """Intrinsics as in ``cam_params.json``, without a pixel-centre correction.

    Attributes:
        width, height: Image size in pixels.
        fx, fy, cx, cy: Focal lengths and principal point in pixels.
        scale: Raw depth counts per scene unit.
        path: The file they come from.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    scale: float
    path: Path

    def principal_point(self, centers: PixelCenters = "auto") -> tuple[float, float]:
        """Principal point in pixels, with the centre of the top left pixel at (0.5, 0.5), as in rasterizers.

        There are two conventions. ``integer``: the centre of the first pixel is 0, so the middle of an image 1200 wide
        is 599.5, as in Replica's own file and in OpenCV; half a pixel is added. ``half``: coordinates start at the
        corner of the image, whose middle is then w / 2; nothing is added. ``auto`` chooses ``half`` if the principal
        point is exactly (w / 2, h / 2), and ``integer`` otherwise.
        """
        if centers == "auto":
            centers = "half" if (self.cx, self.cy) == (self.width / 2, self.height / 2) else "integer"
        shift = 0.5 if centers == "integer" else 0.0
        return self.cx + shift, self.cy + shift


def cam_params_paths(folder: Path) -> tuple[Path, Path]:
    """Where the intrinsics of a scene folder may lie."""
    return folder / "cam_params.json", folder.absolute().parent / "cam_params.json"


def read_cam_params(folder: Path) -> PinholeParams:
    """Intrinsics from the ``cam_params.json`` in the scene folder or the folder above it. Raises DataError if there is
    none, it is not JSON, or a number is missing or out of range."""
    candidates = cam_params_paths(folder)
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise DataError(
            f"{candidates[0]}: not found, nor {candidates[1]}; expected intrinsics "
            '{"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}} in one of them'
        )
    try:
        camera = json.loads(read_text(path))["camera"]
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not valid JSON ({one_line(error)}); expected a camera's intrinsics") from None
    except (KeyError, TypeError):
        raise DataError(f'{path}: no "camera" entry; expected {{"camera": {{"w": ..., "h": ...}}}}') from None
    values: dict[str, float] = {}
    for key in ("w", "h", "fx", "fy", "cx", "cy", "scale"):
        value = camera.get(key) if isinstance(camera, dict) else None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DataError(f'{path}: camera "{key}" is {value!r:.40}; expected a number')
        if not abs(value) < FARTHEST or (value <= 0 and key not in ("cx", "cy")):  # NaN fails too
            raise DataError(f'{path}: camera "{key}" is {value!s:.40}; expected a positive number')
        values[key] = float(value)
    for key in ("w", "h"):
        if values[key] != int(values[key]):
            raise DataError(f'{path}: camera "{key}" is {values[key]}; expected a whole number of pixels')
    return PinholeParams(
        width=int(values["w"]),
        height=int(values["h"]),
        fx=values["fx"],
        fy=values["fy"],
        cx=values["cx"],
        cy=values["cy"],
        scale=values["scale"],
        path=path,
    )
