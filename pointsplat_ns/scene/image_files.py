"""Reads and writes image files."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.system.files import replacing
from pointsplat_ns.system.opening import open_regular

if TYPE_CHECKING:
    from PIL.Image import Image

IMAGE_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF", "PPM")
"""Pillow's names of the supported formats. Pillow decides by content; without this list it would
pass PostScript to another program."""

MOST_PIXELS = 150_000_000
"""Maximum pixels of an image: 450 MB as RGB bytes."""

IMAGE_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    SyntaxError,
    EOFError,
    MemoryError,
    RuntimeError,
    struct.error,
)
"""Exceptions that Pillow raises for damaged images."""


@contextmanager
def open_image(path: Path | str) -> Iterator[Image]:
    """Open a JPEG, PNG, WebP, BMP, TIFF or PPM file as a Pillow image with its header read. Pixels
    can be decoded inside of the context.

    Raises:
        OSError: if the file is missing, not a regular file, or has another format.
        ValueError: if it has more than :data:`MOST_PIXELS`.
    """
    from PIL import Image

    with open_regular(path) as stream:
        start = stream.read(30)
        stream.seek(0)
        if start[:4] == b"RIFF":  # Pillow allocates the pixels of a WebP when it opens it
            _need_decodable(*webp_size(start))
        with warnings.catch_warnings():  # about sizes below our limit
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            try:
                image = Image.open(stream, formats=IMAGE_FORMATS)
            except Image.UnidentifiedImageError as error:
                raise OSError(f"not one of {', '.join(IMAGE_FORMATS)}") from error
            except Image.DecompressionBombError as error:
                raise ValueError(_too_large("too many")) from error
        with image:
            _need_decodable(*image.size)
            yield image


def _need_decodable(width: int, height: int) -> None:
    if width * height > MOST_PIXELS:
        raise ValueError(_too_large(f"{width} x {height}"))


def _too_large(found: str) -> str:
    return f"{found} pixels; expected at most {MOST_PIXELS / 1e6:.0f} million"


def in_unit_range(image: Tensor) -> Tensor:
    """An image of any shape in [0, 1]: bytes are divided by 255, floats are unchanged."""
    return image.float() / 255 if image.dtype == torch.uint8 else image


def exif_hint(path: Path, wanted: tuple[int, int]) -> str:
    """End of the error message for a photo of another size than its camera's (``wanted``: width and
    height, pixels): advice on its EXIF orientation if that would give the camera's shape, else
    empty. EXIF orientations are ignored, as in COLMAP."""
    try:
        with open_image(path) as photo:
            size = photo.size
            orientation = photo.getexif().get(274)
    except IMAGE_ERRORS:
        return ""
    upright = (size[0] - size[1]) * (wanted[0] - wanted[1]) > 0  # possibly scaled
    if orientation not in (5, 6, 7, 8) or upright:  # these swap width and height
        return ""
    return (
        f"; its EXIF orientation ({orientation}) rotates it, and the camera belongs to the rotated "
        "photo: rotate the photos themselves, for example with mogrify -auto-orient *.jpg"
    )


def webp_size(data: bytes) -> tuple[int, int]:
    """Width and height of a WebP image in pixels, from its header (RFC 9649); a ValueError if it is
    not WebP."""
    kind = data[12:16]
    head = data[20:30]
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(head) == 10:
        if kind == b"VP8X":
            return 1 + int.from_bytes(head[4:7], "little"), 1 + int.from_bytes(head[7:10], "little")
        if kind == b"VP8L" and head[0] == 0x2F:
            bits = int.from_bytes(head[1:5], "little")
            return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        if kind == b"VP8 ":
            return int.from_bytes(head[6:8], "little") & 0x3FFF, int.from_bytes(
                head[8:10], "little"
            ) & 0x3FFF
    raise ValueError("not a WebP image")


def read_reduced(path: Path, side: int) -> Tensor | None:
    """An image file reduced to a longer side of about ``side`` pixels: (H, W, 3) float32 in [0, 1],
    transparency over black; None if it cannot be read."""
    from PIL import Image

    try:
        with open_image(path) as opened:
            opened.draft("RGB", (side, side))  # decodes JPEGs at down to an eighth of their size
            opened.thumbnail((side, side), Image.Resampling.BOX)
            image = torch.from_numpy(np.asarray(opened.convert("RGBA"), dtype=np.float32) / 255)
    except IMAGE_ERRORS:
        return None
    return image[..., :3] * image[..., 3:]


def write_picture(picture: Tensor, path: Path, named: bool = True) -> None:
    """Write an image (H, W, 3), clamped to [0, 1], as a PNG, or as a JPEG if the path ends in
    ``.jpg``. ``named`` is as for :func:`~pointsplat_ns.system.files.replacing`. Raises SceneError
    if the file cannot be written."""
    from PIL import Image

    image = Image.fromarray((255 * picture.clamp(0, 1)).round().to(torch.uint8).cpu().numpy())
    with replacing(path, named=named) as part:
        if path.suffix == ".jpg":
            image.save(part, format="JPEG", quality=90)
        else:
            image.save(part, format="PNG")
