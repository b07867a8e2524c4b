"""Arguments and output paths that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

Scene = tyro.conf.Positional[Path]
Output = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
Poses = Path | None
Resolution = Annotated[str | None, tyro.conf.arg(metavar="WxH")]
Up = Annotated[str | None, tyro.conf.arg(metavar="AXIS")]
Bands = Literal["all", "auto", "0", "1", "2", "3"]


def output_beside(scene: Path, suffix: str) -> Path:
    """The default path of the result.

    Args:
        scene: the input file or folder.
        suffix: last part of the result's name.

    Returns:
        For a file, a path beside it: ``room_pruned.ply`` for ``room.ply``. For a run, a path in its folder:
        ``pruned.ply``; never in its checkpoint folder, because nerfstudio takes every file there for a checkpoint.
    """
    if scene.is_dir():
        return scene / f"{suffix}.ply"
    if scene.absolute().parent.name == "nerfstudio_models":
        return scene.absolute().parents[1] / f"{suffix}.ply"
    if scene.suffix.lower() in (".yml", ".yaml"):
        return scene.with_name(f"{suffix}.ply")
    return scene.with_name(f"{scene.stem}_{suffix}.ply")


def need_one_scene(path: Path) -> None:
    """Refuse a folder of scenes where a single scene is expected.

    Raises:
        SceneError: if the path is a folder of scenes.
    """
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.io.scene import ACCEPTED, is_folder_of_scenes

    if is_folder_of_scenes(path):
        raise SceneError(
            f"{path}: a folder without config.yml, so no run; expected {ACCEPTED}; of the commands, compact takes a "
            "folder of scenes"
        )


def check_outputs(scene: Path | None, picture: Path | None, force: bool) -> None:
    """Check output paths before the long computations.

    Args:
        scene: the file to write, of any writable format; None for none.
        picture: the .png file to write; None for none.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if a path has another suffix, is a folder, or is a file that must not be overwritten.
    """
    from pointsplat_ns.io.formats import format_to_write

    if scene is not None:
        format_to_write(scene)
        for name in _file_names(scene):
            _check_free(scene.with_name(name), force)
    check_output(picture, ".png", force)


def check_output(path: Path | None, kind: str, force: bool) -> None:
    """Check the path of one file to write other than a scene.

    Args:
        path: the file; None for none.
        kind: required suffix.
        force: whether an existing file may be overwritten.

    Raises:
        SceneError: if it has another suffix, is a folder, or is a file that must not be overwritten.
    """
    from pointsplat_ns.errors import SceneError

    if path is None:
        return
    if path.suffix.lower() != kind:
        raise SceneError(
            f"{path}: cannot write a {path.suffix or 'nameless'} file; expected a name that ends in {kind}"
        )
    _check_free(path, force)


def _check_free(path: Path, force: bool) -> None:
    from pointsplat_ns.errors import SceneError

    if path.is_dir():
        raise SceneError(f"{path}: is a folder; expected the name of a file to write")
    if path.exists() and not force:
        raise SceneError(f"{path}: exists already; name another file, or overwrite it with --force")


def check_poses(poses: Path | None) -> None:
    """Check that a path can hold cameras.

    Args:
        poses: the file or folder; None for none.

    Raises:
        SceneError: if it is a run or a scene.
    """
    if poses is None:
        return
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.io.camera_files import ACCEPTED, is_camera_file

    if not is_camera_file(poses):
        raise SceneError(
            f"{poses}: a run or a scene; expected {ACCEPTED}; the poses of a run's own dataset need no --poses"
        )


def in_format_of(keep: str, output: Path) -> str:
    """A budget for :func:`~pointsplat_ns.pruning.parse_keep`: a size without a format, such as 5MB, gets the format of
    the output."""
    from pointsplat_ns.io.formats import format_to_write

    return keep.strip() + format_to_write(output).budget_suffix if keep.strip().lower().endswith("mb") else keep


def warn_if_larger(keep: str | None, output: Path) -> None:
    """Warn if a file is larger than its budget: a repaired scene may compress less well than the pruned one."""
    from pointsplat_ns.io.files import logger
    from pointsplat_ns.pruning import Megabytes, parse_keep

    budget = None if keep is None else parse_keep(keep)
    if isinstance(budget, Megabytes) and file_bytes(output) > budget.value * 1e6:
        logger.warning(
            "%s: %.2f MB, more than %s, which held before the repair; try a smaller --keep",
            output, file_bytes(output) / 1e6, budget,
        )  # fmt: skip


def file_bytes(path: Path) -> int:
    """Size of a scene's file in bytes; for the meta.json of a SOG folder, of all parts together."""
    return sum(part.stat().st_size for part in map(path.with_name, _file_names(path)) if part.exists())


def _file_names(path: Path) -> tuple[str, ...]:
    """Names of a scene's files: one, or for the meta.json of a SOG folder, all parts."""
    from pointsplat_ns.io.formats import SOG_META, SOG_PARTS

    return (path.name, *SOG_PARTS) if path.name == SOG_META else (path.name,)
