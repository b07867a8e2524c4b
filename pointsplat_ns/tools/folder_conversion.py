"""Converts every scene of a folder to one format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pointsplat_ns.errors import SceneError
from pointsplat_ns.pruning import cut_sh
from pointsplat_ns.scene.formats import SPZ_VERSION, WRITABLE, format_named, format_to_write
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.system.outputs import outputs_claimed
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.tools.folders import (
    FolderWork,
    Made,
    SceneResult,
    Task,
    output_folder,
    work_through,
)
from pointsplat_ns.tools.placing import place


@normal_mode
@outputs_claimed()
def convert_folder(
    folder: str | Path,
    target_format: str,
    output: str | Path | None = None,
    *,
    sh: str = "all",
    up: str | None = None,
    scale: float = 1.0,
    original_frame: bool = False,
    spz_version: int = SPZ_VERSION,
    jobs: int = 1,
    force: bool = False,
    progress: bool | Progress = False,
) -> list[SceneResult]:
    """Write every scene of a folder in another format, to another folder.

    Unchanged results of the same scenes and options are skipped, so a second call continues an
    interrupted one.

    Args:
        folder: folder of scenes, as for :func:`~pointsplat_ns.compact_folder`.
        target_format: suffix of all results, such as ".spz".
        output: folder for the results ``NAME.spz``, their records ``NAME.spz.json``, and the table
            ``scenes.csv``; by default ``scenes_spz`` beside ``scenes``.
        sh: SH bands to keep: "all", or a maximum degree from "0" to "3".
        up, scale: as for :func:`~pointsplat_ns.place`, for each scene.
        original_frame: undo nerfstudio's rotation, translation and scale of the data of each run.
            Scenes that are not runs fail.
        spz_version: version of ``.spz`` results, as for :func:`~pointsplat_ns.save`.
        jobs, force, progress: as for :func:`~pointsplat_ns.compact_folder`.

    Returns:
        The results, sorted by name. A failed scene has the status "failed" and does not stop the
        others.

    Raises:
        SceneError: if the format cannot be written, there is no scene, or the output folder holds
            other results.
        PointSplatError: if SPZ is not written in that version.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::100], f"{folder}/rooms/hall.ply")
        ...     [result] = ps.convert_folder(f"{folder}/rooms", ".spz")
        >>> result.name, result.status, result.before, result.after
        ('hall', 'done', 629, 629)
    """
    suffix = target_format if target_format.startswith(".") else f".{target_format}"
    if format_named(suffix) is None:
        raise SceneError(f"--to {target_format}: not a format to write; expected {WRITABLE}")
    kind = format_to_write(suffix, spz_version)
    folder = Path(folder)
    target = (
        output_folder(folder, kind.suffix.removeprefix(".")) if output is None else Path(output)
    )
    record = {
        "command": "convert",
        "format": kind.suffix,
        "sh": sh,
        "up": up,
        "scale": scale,
        "original_frame": original_frame,
        "spz_version": spz_version,
    }
    work = _Converting(
        record=record,
        drawn=False,
        force=force,
        sh=sh,
        up=up,
        scale=scale,
        original_frame=original_frame,
        spz_version=spz_version,
    )
    return work_through(folder, target, work, kind.suffix, jobs, progress)


@dataclass(frozen=True)
class _Converting(FolderWork):
    """Converts the scenes of a folder."""

    sh: str
    up: str | None
    scale: float
    original_frame: bool
    spz_version: int
    label: ClassVar[str] = "convert"

    def make(self, task: Task) -> Made:
        dense = read_scene(task.source)
        scene = dense if self.sh == "all" else cut_sh(dense, int(self.sh))
        scene = place(scene, self.up, self.scale, task.source if self.original_frame else None)
        kind = format_to_write(task.output, self.spz_version)
        return Made(dense=dense, scene=scene, kind=kind)
