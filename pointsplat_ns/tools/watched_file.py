"""Notices that the file of a shown scene was written again, or is gone."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.reading import source_parts


class FileState(Enum):
    """State of a scene's file since it was read."""

    SAME = "same"
    CHANGED = "changed"
    GONE = "gone"


class WatchedFile:
    """The file of a scene, or all files of a folder; of a run the newest checkpoint. Made before
    the scene is read, so that no change is missed."""

    def __init__(self, path: Path):
        self.path = path
        self._before = _traits(path)

    def state(self) -> FileState:
        """The state of the file now, by name, size, time and inode. Its content is not read."""
        now = _traits(self.path)
        if now == self._before:
            return FileState.SAME
        return FileState.GONE if now is None else FileState.CHANGED


def _traits(path: Path) -> tuple[tuple[str, int, int, int], ...] | None:
    """Name, size, time and inode of each file of a scene; None if one is missing."""
    try:
        parts = source_parts(path)
        found = [(part, part.stat()) for part in parts]
    except (OSError, SceneError):
        return None
    return tuple((str(part), stat.st_size, stat.st_mtime_ns, stat.st_ino) for part, stat in found)
