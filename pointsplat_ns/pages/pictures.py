"""Pictures for a page: read from PNG files, compressed together to a limit of bytes."""

from __future__ import annotations

import base64
import io
import random
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import one_line
from pointsplat_ns.system.progress import Progress, tracked

ERROR_GAIN = 8
"""Factor on differences in error maps: 32 of 255 levels have the brightest colour."""


def read_png(path: Path, width: int, height: int) -> np.ndarray:
    """The pixels of a PNG file, (height, width, 3) uint8. The size is checked before the pixels are read. Raises
    DataError if the file is missing, not a PNG, damaged, or of another size."""
    from PIL import Image, UnidentifiedImageError

    expected = f"expected a PNG picture of {width} x {height} pixels"
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            if picture.size != (width, height):
                raise DataError(f"{path}: has {picture.width} x {picture.height} pixels; {expected}")
            return np.asarray(picture.convert("RGB"))
    except UnidentifiedImageError as error:
        raise DataError(f"{path}: not a PNG picture; {expected}") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        found = error.strerror if isinstance(error, OSError) and error.strerror else one_line(error)
        raise DataError(f"{path}: cannot be read ({found}); {expected}") from error


def error_map(picture: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The difference of two pictures (H, W, 3) uint8 at half size (rounded up), as colours from black over red to
    white.

    The largest difference of the three channels is averaged over 2 x 2 pixels, which takes a fifth of the bytes, and
    multiplied by :data:`ERROR_GAIN`. A last odd row or column is averaged with itself.

    Example:
        >>> import numpy as np
        >>> grey = np.full((2, 6, 3), 100, np.uint8)
        >>> other = grey + np.repeat([0, 10, 40], 2).astype(np.uint8)[None, :, None]
        >>> error_map(other, grey).sum(axis=2).tolist()
        [[0, 254, 765]]
    """
    difference = np.abs(picture.astype(np.int16) - reference.astype(np.int16)).max(axis=2)
    height, width = difference.shape
    even = np.pad(difference, ((0, height % 2), (0, width % 2)), mode="edge")
    mean = even.reshape((height + 1) // 2, 2, (width + 1) // 2, 2).mean(axis=(1, 3))
    return error_colors()[np.minimum(ERROR_GAIN * mean, 255).round().astype(np.uint8)]


def error_colors() -> np.ndarray:
    """The colours of error maps, (256, 3) uint8, with rising brightness."""
    stops = np.array([[0, 0, 0], [70, 20, 90], [190, 50, 70], [250, 140, 40], [255, 235, 150], [255, 255, 255]])
    places = np.linspace(0, 255, len(stops))
    return (
        np.stack([np.interp(np.arange(256), places, channel) for channel in stops.T], axis=1).round().astype(np.uint8)
    )


def fit(
    pictures: Sequence[Callable[[], np.ndarray]], limit: int, progress: bool | Progress = False
) -> tuple[list[str], str]:
    """Data URIs of pictures as WebP, at the best quality at which all of them together have at most ``limit`` bytes,
    and text on the compression. Pictures are functions that return (H, W, 3) uint8; they are called again for each
    quality, so that only one at a time takes memory. Raises DataError if they do not fit at the lowest quality."""
    # A random sample estimates the size, because every twelfth picture may be of one kind.
    sample = random.Random(0).sample(pictures, min(24, len(pictures)))
    for side in (None, 480, 320, 160):  # largest sides, pixels; None keeps the size
        for level in (90, 82, 74, 66, 58, 50, 42, 34):  # best first
            if sum(len(_uri(picture(), level, side)) for picture in sample) * len(pictures) > limit * len(sample):
                continue
            uris, left = [], limit
            for picture in tracked(pictures, f"compressing pictures, quality {level}", len(pictures), progress):
                uris.append(_uri(picture(), level, side))
                left -= len(uris[-1])
                if left < 0:
                    break
            else:
                return uris, f"WebP of quality {level}" + (
                    "" if side is None else f", at most {side} pixels wide or high"
                )
    raise DataError(f"{len(pictures)} pictures do not fit into {limit / 1e6:.1f} MB; expected fewer points or views")


def _uri(pixels: np.ndarray, level: int, side: int | None) -> str:
    from PIL import Image

    picture = Image.fromarray(pixels)
    if side is not None:
        picture.thumbnail((side, side))
    stream = io.BytesIO()
    # Three times as fast as the default of 4, for 5 % more bytes.
    picture.save(stream, format="WEBP", quality=level, method=2)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
