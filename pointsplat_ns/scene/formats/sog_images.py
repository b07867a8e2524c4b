"""The WebP images of SOG files, in a zip archive or a folder."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.formats.coding import Array
from pointsplat_ns.scene.image_files import webp_size
from pointsplat_ns.system.files import require_file, require_memory
from pointsplat_ns.system.opening import open_regular

SOG_META = "meta.json"


class Images:
    """The parts of one SOG file: a zip archive, a folder, or its ``meta.json``. Raises SceneError,
    and errors for :func:`~pointsplat_ns.scene.formats.coding.damage_named` to convert."""

    def __init__(self, path: Path):
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        self._stream: BinaryIO | None = None
        self._folder = path if path.is_dir() else path.parent
        if path.is_dir() or path.name == SOG_META:
            require_file(self._folder / SOG_META, f"{SOG_META} of a SOG folder")
        else:
            self._stream = open_regular(require_file(path, "a .sog file"))
            try:
                self._zip = zipfile.ZipFile(self._stream)
            except BaseException:
                self._stream.close()
                raise

    def close(self) -> None:
        """Close the archive."""
        if self._zip is not None:
            self._zip.close()
        if self._stream is not None:
            self._stream.close()

    @property
    def size(self) -> int:
        """Bytes of the archive, or of all images in the folder."""
        if self._zip is not None:
            return self.path.stat().st_size
        return sum(part.stat().st_size for part in self._folder.glob("*.webp"))

    def meta(self) -> dict[str, Any]:
        """The content of ``meta.json``."""
        content = json.loads(self._bytes(SOG_META, 1 << 22))  # usually about 20 kB
        if not isinstance(content, dict):
            raise SceneError(
                f"{self.path}: {SOG_META} holds a {type(content).__name__}; expected an object"
            )
        return content

    def pixels(self, name: Any, least: int, width: int | None = None) -> Array:
        """The pixels of one image, (height, width, 4) uint8, RGBA.

        Args:
            name: file name in ``meta.json``.
            least: required number of pixels.
            width: required width, pixels; None for any.

        Raises:
            SceneError: if the image is missing, is not WebP, or has too few or far too many pixels.
        """
        from PIL import Image

        if not isinstance(name, str) or PurePosixPath(name).name != name or "\\" in name:
            raise SceneError(
                f"{self.path}: an image called {name!r}; expected the name of a file beside "
                f"{SOG_META}"
            )
        # version 1 does not say whether SH are 3, 8 or 15; some programs round sides up
        most = 6 * least + (1 << 16)
        data = self._bytes(name, 4 * most)
        across, down = webp_size(data)  # opening an image already allocates its pixels
        if across * down < least or across * down > most or width not in (None, across):
            needed = f"{least} pixels" + (f", {width} across" if width else "")
            raise SceneError(f"{self.path}: {name} has {across} x {down} pixels; expected {needed}")
        require_memory(self.path, 8 * across * down)
        try:
            with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
                return np.asarray(image.convert("RGBA"))
        except Image.DecompressionBombError as error:
            raise SceneError(f"{self.path}: {name} is too large ({error})") from error

    def _bytes(self, name: str, most: int) -> bytes:
        """Content of one part, limited to ``most`` bytes."""
        if self._zip is None:
            part = require_file(self._folder / name, "a part of a SOG folder")
            size = part.stat().st_size
        else:
            entries = [
                entry
                for entry in self._zip.infolist()
                if PurePosixPath(entry.filename).name == name
            ]
            if len(entries) != 1:
                raise SceneError(
                    f"{self.path}: holds {len(entries)} files called {name}; expected one"
                )
            size = entries[0].file_size
        if size > most:
            raise SceneError(f"{self.path}: {name} has {size} bytes; expected at most {most}")
        with open_regular(part) if self._zip is None else self._zip.open(entries[0]) as stream:
            return stream.read(most + 1)  # the declared size may be wrong


def webp(pixels: Array, width: int, height: int) -> bytes:
    """A lossless WebP image of uint8 pixels (up to width * height, 3 or 4), padded with zeros."""
    from PIL import Image

    full = np.zeros((height * width, pixels.shape[1]), np.uint8)
    full[: len(pixels)] = pixels
    stream = io.BytesIO()
    image = Image.fromarray(full.reshape(height, width, -1))
    # "exact" keeps the colours where alpha is 0.
    image.save(stream, "WEBP", lossless=True, exact=True, quality=60, method=4)
    return stream.getvalue()
