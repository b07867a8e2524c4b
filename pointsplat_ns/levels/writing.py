"""Writes levels in the form that is asked for: a folder of files, a streamed SOG, 3D Tiles or a RAD file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.io.formats.sog_stream import STREAM_META, read_sog_stream
from pointsplat_ns.io.outputs import need_folder, need_writable
from pointsplat_ns.levels.folder import check_folder, level_names
from pointsplat_ns.levels.levels import Levels
from pointsplat_ns.levels.tiles import TILESET
from pointsplat_ns.system.progress import Progress

Form = Literal["folder", "stream", "tiles", "paged"]
"""A folder with a file for each level, a streamed SOG, 3D Tiles, or a RAD file."""


@dataclass(frozen=True)
class LevelOutput:
    """Where levels are written, and in which form. Raises PointSplatError if options do not fit each other."""

    path: Path
    """A folder; of the form "paged" a file."""
    form: Form
    force: bool

    @staticmethod
    def of(path: str | Path | None, stream: bool, tiles: bool, force: bool) -> LevelOutput | None:
        """The output of options of :func:`pointsplat_ns.lod`; None if nothing is written."""
        if stream and tiles:
            raise PointSplatError("expected either a stream or 3D Tiles")
        if path is None:
            return None
        paged = Path(path).suffix.lower() == ".rad"
        form: Form = "stream" if stream else "tiles" if tiles else "paged" if paged else "folder"
        return LevelOutput(Path(path), form, force)

    def check(self, count: int) -> None:
        """Check that ``count`` levels can be written."""
        if self.form == "paged":
            return need_writable(self.path, self.force)
        names = {"folder": level_names(count), "tiles": [TILESET], "stream": [STREAM_META]}[self.form]
        check_folder(self.path, names, self.force)
        need_folder(self.path)

    def write(self, levels: Levels, progress: Progress) -> Levels:
        """Write levels; those of a stream are then judged as they are in its files."""
        if self.form == "stream":
            levels.save_stream(self.path, self.force, progress)
            return _read_back(levels, self.path)
        if self.form == "paged":
            levels.save_paged(self.path, progress)
        elif self.form == "tiles":
            levels.save_tiles(self.path, self.force, progress)
        else:
            levels.save(self.path, self.force)
        return levels


def _read_back(levels: Levels, folder: Path) -> Levels:
    """Levels, judged as they are in a stream."""
    judged = []
    for index, level in enumerate(levels):
        quality = None if levels.judge is None else levels.judge.quality(read_sog_stream(folder, index))
        judged.append(replace(level, quality=quality))
    return replace(levels, levels=tuple(judged))
