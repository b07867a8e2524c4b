"""Reads and writes scenes of all supported formats."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import keep_usable, logger, require_file
from pointsplat_ns.io.formats import READABLE, Format, format_named, format_to_read, format_to_write
from pointsplat_ns.io.formats.holding import losses
from pointsplat_ns.io.offsets import warn_if_far
from pointsplat_ns.io.runs import RUN_FILES, Run, open_run
from pointsplat_ns.io.splatfacto import open_checkpoint, read_checkpoint
from pointsplat_ns.system.progress import Progress, progress_bar, silent

SCENE_KINDS = (
    f"a scene ({READABLE}, or a zip of a PLY), a checkpoint of Splatfacto, gsplat or 3DGS (.ckpt, .pt, .pth), or a "
    "Splatfacto run (its folder or config.yml)"
)


def is_scene_file(path: Path | str) -> bool:
    """Whether :func:`read_scene` takes a file for a whole scene, by its suffix. Runs and SOG folders, streamed or not,
    are recognised by their content instead."""
    kind = format_named(Path(path).name)
    return kind is not None and kind.read is not None and kind.suffix.startswith(".")


def is_folder_of_scenes(path: Path | str) -> bool:
    """Whether a path is a folder that is no scene itself, as those of runs and SOG folders are."""
    path = Path(path)
    return path.is_dir() and not (path / RUN_FILES.config).is_file() and format_to_read(path) is None


def read_scene(path: Path | str) -> Gaussians:
    """Read a scene: a file of any format, a checkpoint, or the newest checkpoint of a Splatfacto run.

    Positions that are doubles far from the origin, as in geo-referenced PLYs, are read relative to an offset, which is
    that of the scene. Where float32 has lost their digits already, that is logged.
    The content of a file decides its format, else its name.

    Args:
        path: a 3DGS or compressed ``.ply``, ``.spz``, ``.sog`` (or its folder, or the ``meta.json`` in it), a streamed
            SOG (``lod-meta.json`` or its folder, of which the finest level is read), ``.splat``, ``.ksplat``,
            ``.glb``, a zip of a PLY, a checkpoint of Splatfacto (``.ckpt``), gsplat (``.pt``) or 3DGS (``.pth``),
            ``config.yml`` or a run's folder. The photos of a run are not needed.

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
    if path.is_dir() and (path / RUN_FILES.config).is_file():
        return _scene_of(open_run(path, need_data=False))
    if not path.is_dir():
        require_file(path, SCENE_KINDS)
    kind = format_to_read(path)
    if kind is None and path.suffix.lower() in RUN_FILES.configs:
        return _scene_of(open_run(path, need_data=False))
    if kind is None or kind.read is None:
        what = (
            f"a folder without {RUN_FILES.config} or meta.json"
            if path.is_dir()
            else f"a {path.suffix or 'nameless'} file"
        )
        raise SceneError(f"{path}: {what}; expected {SCENE_KINDS}")
    scene = kind.read(path)
    warn_if_far(scene, path)
    if kind.read is read_checkpoint:
        with suppress(SceneError):  # a checkpoint outside a run
            return scene.replace(antialiased=open_run(path, need_data=False).rasterize_mode == "antialiased")
    return scene


def _scene_of(run: Run) -> Gaussians:
    """The scene of a run's checkpoint, antialiased if the run was trained so."""
    return read_checkpoint(run.checkpoint).replace(antialiased=run.rasterize_mode == "antialiased")


def kind_of(path: Path | str) -> str:
    """What a path is that :func:`read_scene` reads: the name of a format, such as "SPZ", or a run or a checkpoint with
    its program or method and its step. Raises SceneError as :func:`read_scene`.

    Example:
        >>> from pathlib import Path
        >>> import pointsplat_ns
        >>> kind_of(Path(pointsplat_ns.__file__).parent / "examples" / "room.ply")
        '3DGS PLY'
    """
    path = Path(path)
    in_run = path.is_dir() and (path / RUN_FILES.config).is_file()
    kind = None if in_run else format_to_read(path)
    if kind is None:
        run = open_run(path, need_data=False)
        return f"run of {run.method_name or 'an unknown method'}, step {run.step}"
    if kind.read is not read_checkpoint:
        return kind.name
    with suppress(SceneError):  # a checkpoint outside a run
        run = open_run(path, need_data=False)
        return f"checkpoint of {run.method_name or 'an unknown method'}, step {run.step}"
    found = open_checkpoint(path)
    return f"checkpoint of {found.program}" + ("" if found.step is None else f", step {found.step}")


def save(scene: Gaussians, path: Path | str, progress: bool | Progress = False) -> None:
    """Write a scene in the format that the path's name asks for.

    ``.ply`` is the 3DGS PLY: a float32 scene is read back unchanged to the bit. The others keep fewer bits:
    ``.compressed.ply``, ``.spz`` (version 3), ``.sog``, ``meta.json`` (the same in a folder), ``.splat``; ``.glb`` is
    glTF, exact to rounding. Gaussians that cannot be drawn (NaN, or Inf where it is not
    valid) are left out, and their number is logged. The write is atomic and replaces an existing file.

    Args:
        scene: N Gaussians of SH degree d, on any device and of any floating dtype. In a PLY each takes 68 + 12 K bytes,
            with K = (d+1)^2 - 1 and 12 bytes of unused normals.
        path: a path that ends in one of these. Missing folders are created.
        progress: True shows a bar; a function is called with what is being done and the share done of it.

    Raises:
        SceneError: if the path has another suffix, is a folder, or cannot be written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[:100], f"{folder}/small.spz")
        ...     len(ps.load(f"{folder}/small.spz"))
        100
    """
    path = Path(path)
    with progress_bar(progress) as report:
        save_as(format_to_write(path), scene, path, report)


def save_as(
    kind: Format, scene: Gaussians, path: Path, progress: Progress = silent, name: Path | str | None = None
) -> None:
    """Write a scene in a format that is written, whatever the path's name, and warn of what the format does not hold;
    otherwise as :func:`save`. ``name`` is the path in the warning."""
    assert kind.write is not None
    scene = keep_usable(scene.detach().to("cpu", torch.float32), path)
    warn_of_losses(kind, scene, name or path)
    kind.write(scene, path, progress)


def warn_of_losses(kind: Format, scene: Gaussians, name: Path | str) -> None:
    """Log what a format does not hold of a scene, float32 on the CPU, and which format does."""
    found = losses(scene, kind.capacity)
    if found:
        others = (format_named(suffix) for suffix in (".sog", ".glb", ".ply"))
        keeper = next(other.suffix for other in others if other is not None and not losses(scene, other.capacity))
        logger.warning("%s: lost in %s: %s; %s keeps it", name, kind.name, "; ".join(found), keeper)
