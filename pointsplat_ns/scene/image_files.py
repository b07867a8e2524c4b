"""Images as files and as numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.system.files import replacing


def in_unit_range(image: Tensor) -> Tensor:
    """An image of any shape in [0, 1]: bytes count in 255ths, floats stay."""
    return image.float() / 255 if image.dtype == torch.uint8 else image


def exif_hint(path: Path, wanted: tuple[int, int]) -> str:
    """What to do with a photo of another size than its camera's, as the end of an error: about its
    EXIF orientation, if that turns it to the shape that is wanted (width and height, pixels); else
    empty. Photos are read as they are stored, which is how COLMAP reads them, too."""
    from PIL import Image

    try:
        with Image.open(path) as photo:
            size = photo.size
            orientation = photo.getexif().get(274)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return ""
    upright = (size[0] - size[1]) * (wanted[0] - wanted[1]) > 0  # or scaled
    if orientation not in (5, 6, 7, 8) or upright:  # those exchange width and height
        return ""
    return (
        f"; its EXIF orientation ({orientation}) says that it is to be turned, and the camera is "
        "that of the turned "
        "photo: turn the photos themselves, for example with mogrify -auto-orient *.jpg"
    )


def read_reduced(path: Path, side: int) -> Tensor | None:
    """An image file, reduced until its longer side is about ``side`` pixels: (H, W, 3) float32 in
    [0, 1], transparency over black; None if it cannot be read."""
    from PIL import Image

    try:
        with Image.open(path) as opened:
            opened.draft("RGB", (side, side))  # JPEGs are decoded at an eighth of their size
            opened.thumbnail((side, side), Image.Resampling.BOX)
            image = torch.from_numpy(np.asarray(opened.convert("RGBA"), dtype=np.float32) / 255)
    except (OSError, ValueError, SyntaxError, MemoryError, Image.DecompressionBombError):
        return None
    return image[..., :3] * image[..., 3:]


def write_picture(picture: Tensor, path: Path, named: bool = True) -> None:
    """Write an image (H, W, 3), clamped to [0, 1], as a PNG; as a JPEG if the path ends in
    ``.jpg``; ``named`` as of :func:`~pointsplat_ns.system.files.replacing`. Raises SceneError if it
    cannot be written."""
    from PIL import Image

    image = Image.fromarray((255 * picture.clamp(0, 1)).round().to(torch.uint8).cpu().numpy())
    with replacing(path, named=named) as part:
        if path.suffix == ".jpg":
            image.save(part, format="JPEG", quality=90)
        else:
            image.save(part, format="PNG")
