"""Identifies the file that a scene is read from by its hash."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import content_hash, one_line, require_memory
from pointsplat_ns.io.formats import SOG_META, STREAM_META, format_to_read
from pointsplat_ns.io.formats.sog_stream import stream_parts
from pointsplat_ns.io.runs import RUN_FILES, may_be_run, open_run
from pointsplat_ns.io.splatfacto import checkpoint_parts


@dataclass(frozen=True)
class SourceFile:
    """The file that a dense scene was read from. Of a SOG folder, streamed or not, and of a checkpoint in parts,
    ``name`` is that of the folder, ``bytes`` are those of all files, and ``sha256`` is that of the lines "path hash" of
    each, by its path in the folder."""

    name: str
    bytes: int
    sha256: str


def source_file(path: Path | str) -> SourceFile:
    """The file that :func:`~pointsplat_ns.io.read_scene` reads a scene from: for a run, its checkpoint. Raises
    SceneError if there is none, or it cannot be read."""
    parts = source_parts(path)
    for part in parts:
        require_memory(part, part.stat().st_size)  # before hours of hashing a sparse file
    if len(parts) > 1 or parts[0].name == SOG_META:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        hashes = "".join(f"{part.relative_to(folder).as_posix()} {content_hash(part)}\n" for part in parts)
        total = sum(part.stat().st_size for part in parts)
        return SourceFile(folder.resolve().name, total, hashlib.sha256(hashes.encode()).hexdigest())
    [part] = parts
    digest = content_hash(part)
    return SourceFile(part.name, part.stat().st_size, digest)


def source_parts(path: Path | str) -> list[Path]:
    """The files that a scene is read from: all of a SOG folder, by name, streamed or not, the checkpoint of a run, all
    parts of a checkpoint, or one. Raises SceneError if a run has none, or a folder cannot be read."""
    path = Path(path)
    parts = _sog_parts(path)
    if parts:
        return parts
    kind = format_to_read(path) if path.is_file() else None
    if kind is None and may_be_run(path):
        return [open_run(path, need_data=False).checkpoint]
    return checkpoint_parts(path)


def _folder_of(path: Path) -> Path:
    return path.parent if path.name in (SOG_META, STREAM_META) else path


def _sog_parts(path: Path) -> list[Path]:
    """The files of a SOG folder, streamed or not, by name: its JSON and its images; none if the path is no such
    folder."""
    folder = _folder_of(path)
    streamed = path.name != SOG_META and (folder / STREAM_META).is_file()
    if not (streamed or (folder / SOG_META).is_file()) or (folder / RUN_FILES.config).is_file():
        return []
    try:
        if streamed:
            names = sorted(stream_parts(folder / STREAM_META))
        else:
            names = sorted(part for part in folder.iterdir() if part.name == SOG_META or part.suffix.lower() == ".webp")
        return [part for part in names if part.is_file()]
    except OSError as error:
        raise SceneError(f"{folder}: cannot be read ({error.strerror or one_line(error)})") from error
