"""Commands on all scenes of a folder."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from pointsplat_ns.compression.compact import compact_scene
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.quality import judge_of
from pointsplat_ns.compression.requests import CompactRequest, Effort, PruneRequest, RepairBudget
from pointsplat_ns.compression.target_search import compact_to_psnr
from pointsplat_ns.compression.trained_refiner import refiner_at
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.formats import format_like, format_to_write
from pointsplat_ns.io.outputs import need_new, need_suffix
from pointsplat_ns.io.scene import read_scene, source_file
from pointsplat_ns.looking.sizes import parse_resolution, size_text
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.nerfstudio_plugin.dataset_views import view_source
from pointsplat_ns.pages.gallery import draw_pair, write_gallery, write_sheet
from pointsplat_ns.placing import place
from pointsplat_ns.pruning import Keep, cut_sh
from pointsplat_ns.scene_folder import (
    Command,
    CommandOptions,
    SceneResult,
    SmallerScene,
    output_folder,
    run_on_folder,
)
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.system.tensors import normal_mode


@normal_mode
def compact_folder(
    folder: str | Path,
    output: str | Path | None = None,
    keep: Keep | str | None = None,
    refiner: str | Path | None = None,
    *,
    by: str | None = None,
    sh: str = "all",
    clean: bool = False,
    effort: Effort = "quick",
    seconds: float | None = None,
    target_db: float | None = None,
    resolution: tuple[int, int] | str | None = None,
    data: str | Path | None = None,
    target_format: str | None = None,
    html: str | Path | None = None,
    picture: str | Path | None = None,
    jobs: int = 1,
    force: bool = False,
    progress: bool | Progress = False,
) -> list[SceneResult]:
    """Compact every scene of a folder by :func:`compact`, and write the results to another folder.

    Unchanged results of the same scene and options are kept, so another call continues an interrupted one. Several
    calls may work on the same folders at the same time; one of them claims each scene.

    Args:
        folder: scenes are the files with Gaussians below it, and the newest Splatfacto run of each experiment.
        output: folder for ``NAME.ply`` and its record ``NAME.ply.json`` of each scene, and the table ``scenes.csv``;
            by default beside ``folder``: ``scenes_compact`` for ``scenes``. Each result has the format of its scene's
            file, or is a PLY where that cannot be written.
        keep: as for :func:`compact`; a size such as "5MB" is that of the result in its own format. A scene with no more
            Gaussians than a count is copied.
        refiner: as for :func:`~pointsplat_ns.load_refiner`, or "shipped"; None for no refiner.
        by, sh, clean, effort: as for :func:`compact`.
        seconds: duration of the repair of each scene, as for :func:`compact`.
        target_db: as for :func:`compact`, for each scene in the format of its result.
        resolution: as for :func:`prune`.
        data: folder above the data of the runs, or that of one, where it is no longer where the runs say. A run whose
            data is not found gets sampled views, and a note.
        target_format: suffix of all results, such as ".sog"; by default each result has the format of its scene.
        html: an .html file for a gallery of all scenes before and after, with links to their files. It is written at
            the end, also after an interruption, from what is finished.
        picture: a .png file for the same pictures.
        jobs: number of processes, which share the cores. With more than one, the program must be a file whose main code
            is under ``if __name__ == "__main__":``, as for any Python program that starts processes.
        force: overwrite files of other origin, changed files, and results with other options.
        progress: True shows a bar; a function is called with the name of the current task and its share done.

    Returns:
        The result of each scene, sorted by name. A failing scene does not stop the others; its status is
        "failed".

    Raises:
        BudgetError, PointSplatError: if an option is not valid.
        DataError: if the number of jobs is not valid.
        SceneError: if there is no scene, the output folder holds other results, or a page or picture that an earlier
            call did not write is there.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for every in (100, 200):
        ...         ps.save(ps.example_room()[::every], f"{folder}/rooms/{every}.ply")
        ...     results = ps.compact_folder(f"{folder}/rooms", keep=50, effort="instant")
        >>> [(result.name, result.status, result.before, result.after) for result in results]
        [('100', 'done', 629, 50), ('200', 'done', 315, 50)]
    """
    folder = Path(folder)
    target = output_folder(folder, "compact") if output is None else Path(output)
    size, trained = parse_resolution(resolution), _loaded(refiner)
    request = CompactRequest.of(trained, keep, by, sh, clean, RepairBudget(effort, seconds), target_db=target_db)
    make = _Compacting(request.prune, size, data, target_format, refiner, request.repair, target_db)
    options = {
        **make.options(),
        "refiner": None if trained is None else source_file(trained.source).sha256,
        "effort": effort if seconds is None else None,
        "seconds": seconds,
        **({} if target_format is None else {"format": target_format}),
    }
    if target_db is not None:
        options |= {"keep": None, "target_db": target_db}
    page, sheet = (None if path is None else Path(path) for path in (html, picture))
    again = force or (target / FOLDER_FILES.scenes).exists()
    for path, end in ((page, ".html"), (sheet, ".png")):
        if path is not None:
            need_suffix(path, end)
            need_new(path, again)

    def show(results: Sequence[SceneResult]) -> None:
        if page is not None:
            write_gallery(page, folder.resolve().name, results)
        if sheet is not None:
            write_sheet(sheet, results)

    draw = functools.partial(_drawn, data) if page or sheet else None
    command = Command("compact", make, options, target_format, draw)
    return run_on_folder(folder, target, command, jobs, force, progress, show)


def prune_folder(
    folder: Path,
    output: Path,
    request: PruneRequest,
    resolution: tuple[int, int] | str | None = None,
    data: str | Path | None = None,
    jobs: int = 1,
    force: bool = False,
    progress: bool | Progress = False,
) -> list[SceneResult]:
    """Prune every scene of a folder by :func:`prune`; folders, sizes and results as of :func:`compact_folder`."""
    pruning = _Pruning(request, parse_resolution(resolution), data, None)
    options = {**pruning.options(), "opacity_weight": request.opacity_weight}
    return run_on_folder(folder, output, Command("prune", pruning, options), jobs, force, progress)


def convert_folder(
    folder: Path,
    output: Path,
    suffix: str,
    *,
    sh: str = "all",
    up: str | None = None,
    scale: float = 1.0,
    original_frame: bool = False,
    offset: Sequence[float] | Literal["centre"] | None = None,
    jobs: int = 1,
    force: bool = False,
    progress: bool | Progress = False,
) -> list[SceneResult]:
    """Write every scene of a folder in another format, named by its suffix, such as ".spz"; otherwise as
    :func:`compact_folder`. Raises SceneError if the format is not written as one file."""
    if not suffix.startswith(".") or format_to_write(suffix).suffix != suffix:
        raise SceneError(f"{suffix}: no suffix of scene files that are written; expected one such as .spz")
    options: CommandOptions = {
        **{"format": suffix, "sh": sh, "up": up, "scale": scale, "original_frame": original_frame},
        **({} if offset is None else {"offset": str(offset)}),
    }
    command = Command("convert", functools.partial(_converted, sh, up, scale, original_frame, offset), options, suffix)
    return run_on_folder(folder, output, command, jobs, force, progress)


_loaded = functools.cache(refiner_at)


@dataclass(frozen=True)
class _Pruning:
    """Prunes the scenes of a folder. It is pickled for other processes."""

    request: PruneRequest
    resolution: tuple[int, int] | None
    data: str | Path | None
    suffix: str | None
    """Suffix of the results; None for the format of each scene."""

    def options(self) -> dict[str, str | float | bool | None]:
        """All options that a result depends on."""
        request, size, data = self.request, self.resolution, self.data
        return {
            "keep": str(request.budget),
            "by": request.by,
            "sh": request.sh,
            "clean": request.clean,
            "resolution": None if size is None else size_text(size),
            **({} if data is None else {"data": str(data)}),
        }

    def __call__(self, dense: Gaussians, path: Path) -> SmallerScene:
        """Make one scene smaller."""
        source = view_source(dense, run=path, data=self.data, resolution=self.resolution)
        kind = format_like(path) if self.suffix is None else format_to_write(self.suffix)
        scene = self.smaller(dense, replace(self.request, suffix=kind.budget_suffix), source, path)
        whole = scene.sh_degree == dense.sh_degree and len(scene) == len(dense)
        whole = whole and all(map(torch.equal, scene.tensors(), dense.tensors()))
        note = "kept whole" if whole else source.missing[2:-1]
        judge = None if whole and kind.suffix == ".ply" else judge_of(dense, source)  # nothing differs
        return SmallerScene(scene, judge, note, same=whole and isinstance(self.request.budget, int))

    def smaller(self, dense: Gaussians, request: PruneRequest, source: ViewSource, path: Path) -> Gaussians:
        """The smaller scene."""
        return prune_scene(dense, request, source).scene


@dataclass(frozen=True)
class _Compacting(_Pruning):
    """Compacts the scenes of a folder."""

    refiner: str | Path | None
    """Loaded by each process."""
    repair: RepairBudget
    target_db: float | None

    def smaller(self, dense: Gaussians, request: PruneRequest, source: ViewSource, path: Path) -> Gaussians:
        """The compact scene."""
        whole = CompactRequest(request, _loaded(self.refiner), self.repair, target_db=self.target_db)
        result = (compact_scene if self.target_db is None else compact_to_psnr)(dense, whole, source)
        if result.interrupted:
            raise KeyboardInterrupt  # Ctrl-C ends the whole command, not the work on one scene
        return result.scene


def _drawn(data: str | Path | None, scene: Path, result: Path, picture: Path) -> None:
    """Draw a scene and its result to a file; nothing if nothing of the scene is visible."""
    before, after = read_scene(scene), read_scene(result)
    after = after if after.offset is None else after.at_offset(before.offset)
    with suppress(DataError):
        draw_pair(before, after, view_source(before, run=scene, data=data).known(VIEW_COUNTS.opening), picture)


def _converted(
    sh: str,
    up: str | None,
    scale: float,
    original_frame: bool,
    offset: Sequence[float] | Literal["centre"] | None,
    dense: Gaussians,
    path: Path,
) -> SmallerScene:
    """One scene of a folder for another format."""
    cut = dense if sh == "all" else cut_sh(dense, int(sh))
    return SmallerScene(place(cut, up, scale, path if original_frame else None, offset))
