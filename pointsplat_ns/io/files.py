"""Helpers of all readers and writers: checks, hashes, atomic writes."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians

logger = logging.getLogger("pointsplat_ns")


def require_file(path: Path | str, what: str) -> Path:
    """``path`` as a Path, if it names a regular file.

    Args:
        path: the file.
        what: the expected kind of file, for the error ("a 3DGS PLY file").

    Raises:
        SceneError: if there is no file at ``path``, or a folder or a pipe.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path}: no such file; expected {what}")
    if not path.is_file():
        raise SceneError(f"{path}: not a regular file; expected {what}")
    return path


def content_hash(path: Path | str) -> str:
    """SHA-256 of a file's bytes, as 64 hexadecimal digits.

    Args:
        path: the file; it is read in pieces, so that it need not fit into memory.

    Raises:
        SceneError: if there is no such file, or it cannot be read.
    """
    path = require_file(path, "a scene to read")
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while piece := stream.read(1 << 20):
                digest.update(piece)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or one_line(error)})") from error
    return digest.hexdigest()


def one_line(error: BaseException, limit: int = 160) -> str:
    """The first line of an exception's text, at most ``limit`` characters; the name of its type if it has no text."""
    lines = str(error).strip().splitlines()
    text = lines[0].strip() if lines else type(error).__name__
    return text if len(text) <= limit else text[: limit - 3] + "..."


def file_stem(text: str) -> str:
    """``text`` as a file name: other characters than letters, digits and ``_ . + -`` become ``-``; "scene" if nothing
    is left."""
    return re.sub(r"[^\w.+-]+", "-", text).strip("-.") or "scene"


@contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to. It replaces ``path`` when the block ends without an error, else it
    is removed.

    Missing parent folders are created.

    Raises:
        SceneError: if ``path`` is a folder or cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise SceneError(f"{path}: is a folder; expected the name of a file to write")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        os.replace(part, path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({error.strerror or one_line(error)})") from error
    finally:
        if part.parent.is_dir():
            part.unlink(missing_ok=True)


def keep_usable(scene: Gaussians, path: Path | str) -> Gaussians:
    """``scene`` without the Gaussians that cannot be drawn, whose number is logged.

    Opacity logits of +-Inf and log-scales of -Inf are valid (see
    :meth:`~pointsplat_ns.gaussians.Gaussians.usable`).
    """
    usable = scene.usable()
    dropped = len(scene) - int(usable.sum())
    if not dropped:
        return scene
    logger.warning("%s: dropped %d of %d Gaussians with NaN or infinite values", path, dropped, len(scene))
    return scene[usable]
