"""Pictures in pages, and pictures from PNG files."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import one_line


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


def picture_uri(pixels: np.ndarray) -> str:
    """The data URI of a picture (H, W, 3) uint8 as WebP."""
    from PIL import Image

    stream = io.BytesIO()
    # Three times as fast as the default of 4, for 5 % more bytes.
    Image.fromarray(pixels).save(stream, format="WEBP", quality=82, method=2)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
