"""Keeps what nerfstudio's dataparsers open within the formats of photos."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from PIL import Image

from pointsplat_ns.errors import DataError
from pointsplat_ns.scene.image_files import IMAGE_ERRORS, IMAGE_FORMATS, open_image
from pointsplat_ns.system.files import one_line


@contextmanager
def photos_alone() -> Iterator[None]:
    """While open, Pillow opens nothing but what
    :func:`~pointsplat_ns.scene.image_files.open_image` takes, whoever asks; any other file that is
    named is a DataError.

    nerfstudio's dataparsers open photos with Pillow to learn their size. Pillow decides by content,
    waits for pipes, and hands PostScript to another program.
    """
    usual = Image.open

    def guarded(fp: Any, mode: Any = "r", formats: Any = None) -> Image.Image:
        if isinstance(fp, (str, os.PathLike)):
            try:
                with open_image(os.fspath(fp)):
                    pass
            except FileNotFoundError:
                raise
            except IMAGE_ERRORS as error:
                raise DataError(
                    f"{fp}: cannot be read as a photo ({one_line(error, 80)})"
                ) from error
        return usual(fp, mode, IMAGE_FORMATS if formats is None else formats)

    Image.open = guarded  # type: ignore[assignment]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            yield
    finally:
        Image.open = usual
