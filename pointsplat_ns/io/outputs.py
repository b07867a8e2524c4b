"""Checks of the files and folders that a command is going to write, before its work."""

from __future__ import annotations

import os
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import one_line, target_of


def need_suffix(path: Path, suffix: str) -> None:
    """Raise a SceneError if a path does not end in a suffix, such as ``.png``."""
    if path.suffix.lower() != suffix:
        what = f"a {path.suffix or 'nameless'} file"
        raise SceneError(f"{path}: cannot write {what}; expected a name that ends in {suffix}")


def need_new(path: Path, force: bool) -> None:
    """Raise a SceneError if a path exists and may not be replaced."""
    if target_of(path).exists() and not force:
        raise SceneError(f"{path}: exists already; name another file, or overwrite it with --force")


def need_writable(path: Path, force: bool) -> None:
    """Raise a SceneError if a file cannot be written: it is a folder, a pipe or a device, its folder takes none, or it
    exists and ``force`` does not allow to replace it."""
    try:
        need_new(path, force)
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({error.strerror or one_line(error)})") from error
    _need_place(path, target_of(path).absolute().parent)


def need_folder(path: Path) -> None:
    """Raise a SceneError if nothing can be written to a folder, which may be missing."""
    if os.path.lexists(path) and not path.is_dir():
        raise SceneError(f"{path}: is a file; expected the name of a folder")
    _need_place(path, path.absolute())


def _need_place(path: Path, folder: Path) -> None:
    """Raise a SceneError, about ``path``, if a folder cannot be written to, or cannot be made."""
    try:
        above = next(place for place in (folder, *folder.parents) if place.exists())
    except OSError as error:
        raise SceneError(f"{path}: cannot be written ({error.strerror or one_line(error)})") from error
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        why = "is no folder" if not above.is_dir() else "takes no files"
        raise SceneError(f"{path}: cannot be written ({above} {why})")
