"""Reads, writes and identifies scenes of all supported formats."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.checkpoints import read_checkpoint
from pointsplat_ns.scene.formats import (
    READABLE,
    SOG_META,
    SPZ_VERSION,
    STREAM_META,
    Format,
    format_named,
    format_to_read,
    format_to_write,
)
from pointsplat_ns.scene.formats.capacity import losses
from pointsplat_ns.scene.formats.sog_stream import stream_parts
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.offsets import warn_if_far
from pointsplat_ns.scene.runs import RUN_FILES, Run, may_be_run, open_run
from pointsplat_ns.scene.usable import keep_usable
from pointsplat_ns.system.files import content_hash, failure_named, logger, require_file
from pointsplat_ns.system.outputs import claim, outputs_claimed
from pointsplat_ns.system.progress import Progress, progress_bar, silent

SCENE_KINDS = (
    f"a scene ({READABLE}), a checkpoint of Splatfacto, gsplat or 3DGS (.ckpt, .pt, .pth), or a "
    "Splatfacto run (its folder or config.yml)"
)


def is_scene_file(path: Path | str) -> bool:
    """Whether a file is a scene by its suffix. Runs and SOG folders, streamed or not, are
    recognised by content instead."""
    kind = format_named(Path(path).name)
    return kind is not None and kind.read is not None and kind.suffix.startswith(".")


def is_folder_of_scenes(path: Path | str) -> bool:
    """Whether a path is a folder, but not a scene itself, as folders of runs and SOG are."""
    path = Path(path)
    return (
        path.is_dir() and not (path / RUN_FILES.config).is_file() and format_to_read(path) is None
    )


def read_scene(path: Path | str, all_rows: bool = False) -> Gaussians:
    """Read a scene: a file of any format, a checkpoint, or the newest checkpoint of a run.

    Gaussians that cannot be drawn (NaN, or Inf where it is not valid) are dropped, and their number
    is logged. Positions that are doubles far from the origin, as in geo-referenced PLYs, are read
    relative to the scene's offset. If float32 positions have already lost precision, a warning is
    logged. The format is identified by content, or else by name.

    Args:
        path: a 3DGS or compressed ``.ply``, ``.spz``, ``.sog`` (or its folder, or its
            ``meta.json``), a streamed SOG (``lod-meta.json`` or its folder; the finest level is
            read), ``.splat``, ``.glb`` or ``.gltf`` with Gaussians, 3D Tiles of them
            (``tileset.json`` or its folder) or a ``.rad`` (of both, the finest level), a checkpoint
            of Splatfacto (``.ckpt``) or gsplat (``.pt``), ``config.yml`` or a run's folder. The
            photos of a run are not needed.
        all_rows: whether to include Gaussians that cannot be drawn.

    Returns:
        The scene, float32 on the CPU. Log-scales and logits are those of the file.

    Raises:
        SceneError: if the path is none of these, or the file is damaged.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(Gaussians.empty(sh_degree=2), f"{folder}/nothing.ply")
        ...     read_scene(f"{folder}/nothing.ply").sh_degree
        2
    """
    path = Path(path)
    read, file, _, run = _found(path)
    scene = read(file)
    if not all_rows:
        scene = keep_usable(scene, file)
        warn_if_far(scene, path)
    return scene if run is None else scene.replace(antialiased=run.rasterize_mode == "antialiased")


def _found(path: Path) -> tuple[Callable[[Path], Gaussians], Path, str, Run | None]:
    """The reader of a scene, the file to read, its kind, and the run that it belongs to, or None.
    Raises SceneError as :func:`read_scene`."""
    is_run = path.is_dir() and (path / RUN_FILES.config).is_file()
    if not path.is_dir():
        require_file(path, SCENE_KINDS)
    kind = None if is_run else format_to_read(path)
    if kind is not None:
        assert kind.read is not None
        run = None
        if kind.read is read_checkpoint:
            with suppress(SceneError):  # the checkpoint is not in a run
                run = open_run(path, need_data=False)
        return kind.read, path, kind.name, run
    if is_run or path.suffix.lower() in (".yml", ".yaml"):
        run = open_run(path, need_data=False)
        return read_checkpoint, run.checkpoint, "run", run
    what = (
        f"a folder without {RUN_FILES.config} or {SOG_META}"
        if path.is_dir()
        else f"a {path.suffix or 'nameless'} file"
    )
    raise SceneError(f"{path}: {what}; expected {SCENE_KINDS}")


def kind_of(path: Path | str) -> str:
    """Kind of a path for :func:`read_scene`: a format name, such as "SPZ", or a run or its
    checkpoint, with method and step. Raises SceneError as :func:`read_scene`.

    Example:
        >>> from pathlib import Path
        >>> import pointsplat_ns
        >>> kind_of(Path(pointsplat_ns.__file__).parent / "examples" / "room.ply")
        '3DGS PLY'
    """
    _, _, name, run = _found(Path(path))
    return (
        name
        if run is None
        else f"{name} of {run.method_name or 'an unknown method'}, step {run.step}"
    )


def save(
    scene: Gaussians,
    path: Path | str,
    progress: bool | Progress = False,
    overwrite: bool = False,
    spz_version: int = SPZ_VERSION,
) -> None:
    """Write a scene in the format of the path's suffix.

    ``.ply`` is the 3DGS PLY: a float32 scene is read back exact to the bit. ``.spz``,
    ``.sog``, ``.splat`` and ``.spz.glb`` have fewer bits; ``.glb`` and ``.gltf`` have floats as
    drawn, see :mod:`~pointsplat_ns.scene.formats.gltf`. Gaussians that cannot be drawn (NaN, or Inf
    where it is not valid) are dropped, and their number is logged. The write is atomic.

    Args:
        scene: N Gaussians of SH degree d, on any device and of any floating dtype. In a PLY each
            takes 68 + 12 K bytes, with K = (d+1)^2 - 1 and 12 bytes of unused normals.
        path: ends in one of these suffixes. Missing folders are created.
        progress: True shows a progress bar; a function is called with the current step and its
            share done.
        overwrite: whether to replace an existing file.
        spz_version: version of an ``.spz``: 4, which the format's own library, SuperSplat,
            PlayCanvas and three.js read; 3 for Spark 2.2 and older viewers; or 2 for viewers from
            before 2025.

    Raises:
        SceneError: if the path has another suffix, is a folder, cannot be written, or exists
            without ``overwrite``.
        PointSplatError: if SPZ is not written in that version.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[:100], f"{folder}/small.spz")
        ...     len(ps.load(f"{folder}/small.spz"))
        100
    """
    path = Path(path)
    kind = format_to_write(path, spz_version)
    with outputs_claimed(), progress_bar(progress) as report:
        if not overwrite:
            claim(path)
        if path.is_file() and not overwrite:
            raise SceneError(
                f"{path}: exists already; name another file, or replace it with overwrite=True"
            )
        save_as(kind, scene, path, report)


def save_as(
    kind: Format,
    scene: Gaussians,
    path: Path,
    progress: Progress = silent,
    name: Path | str | None = None,
) -> None:
    """Write a scene in a given format, whatever the path's suffix, and warn about losses; otherwise
    as :func:`save`. ``name`` is the path in the warning."""
    assert kind.write is not None
    scene = keep_usable(scene.detach().to("cpu", torch.float32), path)
    warn_of_losses(kind, scene, name or path)
    if kind.up and scene.up is None:
        logger.warning(
            "%s: %s is %s up, and the scene declares no up axis; if it looks turned, `pointsplat "
            "convert SCENE %s --up %s` turns it",
            *(name or path, kind.name, kind.up, Path(name or path).name, kind.up),
        )
    kind.write(scene, path, progress)


def warn_of_losses(kind: Format, scene: Gaussians, name: Path | str) -> None:
    """Log the losses of a scene, float32 on the CPU, in a format, and a format without them."""
    found = losses(scene, kind.capacity)
    if found:
        others = (format_named(suffix) for suffix in (".sog", ".ply"))
        keeper = next(
            other.suffix
            for other in others
            if other is not None and not losses(scene, other.capacity)
        )
        logger.warning("%s: lost in %s: %s; %s keeps it", name, kind.name, "; ".join(found), keeper)


class SourceFile(NamedTuple):
    """The file that a dense scene was read from."""

    name: str
    """For a folder of SOG, streamed or not, or of 3D Tiles, that folder; for a checkpoint in parts,
    the one named."""
    bytes: int
    """Total of all files of a folder."""
    sha256: str
    """For a folder, the hash of the lines "path hash" of its files, sorted by relative path."""


def source_file(path: Path | str) -> SourceFile:
    """The file that :func:`~pointsplat_ns.scene.read_scene` reads a scene from: for a run, its
    checkpoint. Raises SceneError if it is missing or cannot be read."""
    parts = source_parts(path)
    hashes = {part: content_hash(part) for part in parts}
    size = sum(part.stat().st_size for part in parts)
    name = parts[0].name
    digest = hashes[parts[0]]
    if len(parts) > 1 or name == SOG_META:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        lines = (
            f"{part.relative_to(folder).as_posix()} {digest}\n" for part, digest in hashes.items()
        )
        is_file = is_scene_file(path) or Path(path).suffix == ".pt"
        name = Path(path).name if is_file else folder.resolve().name
        digest = hashlib.sha256("".join(lines).encode()).hexdigest()
    return SourceFile(name, size, digest)


def source_parts(path: Path | str) -> list[Path]:
    """The files of a scene: all of a SOG folder, by name, streamed or not; of 3D Tiles, a ``.gltf``
    or ``.rad``, the file and those that it names; the checkpoint of a run; all parts of a
    checkpoint; or one file. Raises SceneError if a run has no checkpoint, a part is missing, or a
    folder cannot be read."""
    path = Path(path)
    folder = path.parent if path.name in (SOG_META, STREAM_META) else path
    streamed = path.name != SOG_META and (folder / STREAM_META).is_file()
    if (streamed or (folder / SOG_META).is_file()) and not (folder / RUN_FILES.config).is_file():
        with failure_named(folder, "read"):
            images = (
                part
                for part in folder.iterdir()
                if part.name == SOG_META or part.suffix.lower() == ".webp"
            )
            return sorted(
                filter(Path.is_file, stream_parts(folder / STREAM_META) if streamed else images)
            )
    kind = None if (folder / RUN_FILES.config).is_file() else format_to_read(path)
    if kind is not None and kind.parts is not None:
        return kind.parts(path / kind.suffix if path.is_dir() else path)
    if kind is None and may_be_run(path):
        return [open_run(path, need_data=False).checkpoint]
    return [path]
