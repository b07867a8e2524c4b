"""The public functions on whole scenes, available as ``import pointsplat_ns as ps``.

The commands run the same pipeline as these functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pointsplat_ns.pipeline import run
from pointsplat_ns.pipeline.options import CompactOptions, PruneOptions, ViewOptions
from pointsplat_ns.pipeline.repair_budget import Effort, RepairBudget
from pointsplat_ns.pipeline.report import Report
from pointsplat_ns.pipeline.subject import Source, read_subject
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner
from pointsplat_ns.pruning import Keep
from pointsplat_ns.scene.formats import SPZ_VERSION
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene, source_file
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.outputs import outputs_claimed
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.quantities import parse_megabytes
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.tools.comparison_plots import plot_cleaning
from pointsplat_ns.tools.comparison_plots import plot_views as draw_views
from pointsplat_ns.tools.levels.levels import LevelOutput, Levels, make_levels, parse_levels
from pointsplat_ns.tools.wording import (
    cleaning_lines,
    log_lines,
    log_report,
    note_lines,
    verdict_text,
)

EXAMPLE = Path(__file__).parent / "examples" / "room.ply"
"""The shipped example scene."""


def example_room() -> Gaussians:
    """A small built-in scene: a room outside of the shipped refiner's training.

    Returns:
        The scene, float32 on the CPU, in metres with z up.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.example_room().sh_degree
        1
    """
    return read_scene(EXAMPLE)


def prune(
    scene: Source,
    keep: Keep | str = 0.3,
    by: str = "merge",
    *,
    sh: str = "all",
    opacity_weight: float | None = None,
    clean: bool = False,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    photos: bool | str | Path = False,
    memory: float | str | None = None,
    jobs: int | None = None,
    spz_version: int = SPZ_VERSION,
    progress: bool | Progress = False,
) -> Gaussians:
    """Make a scene smaller: merge neighbours, or keep the most important Gaussians. Needs no
    photos.

    PSNR in held-out photos is logged at level INFO; details (cut SH bands, reached PSNR, origin of
    views) at level DEBUG.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        keep: size of the result: a ratio (0.3, "30%"), a count (50000), the size of a PLY ("12MB")
            or of a file of another format ("12MB.spz"), or "auto:35", the smallest scene whose
            renders reach 35 dB PSNR against the given scene ("auto" alone means 35). For .spz and
            .sog the count is searched for.
        by: pruning method. "merge" replaces groups of neighbours by one Gaussian. The others select
            Gaussians, bit for bit: "coverage", "paper" (eq. 3), "authors", "opacity", "random", and
            "lightgaussian" and "pup", which score Gaussians in ``views``.
        sh: SH bands to keep: "all", a maximum degree ("0" to "3"), or "auto", the lowest degree
            whose renders reach 40 dB.
        opacity_weight: lambda of "paper" and "authors", in [0, 1]; by default the paper's 0.3.
        clean: first remove Gaussians that cannot be drawn or seen; ``keep`` still refers to the
            whole scene.
        views: cameras for all rendering: views, a run whose dataset has the poses, or a camera file
            (``cameras.json`` of 3DGS, ``transforms.json`` of nerfstudio, the folder of a COLMAP
            model). By default from the run at ``scene``, else from a camera file beside it, else
            sampled.
        resolution: width and height at which people view the scene, pixels: (1920, 1080) or
            "1920x1080". Decisions by rendering use this size. By default the size of the photos or
            of given views, else 1920 x 1080.
        up: up axis of the scene, such as "z" or "-y", for sampled views; by default declared by the
            scene, or estimated.
        data: folder of the run's photos and poses, or a folder above it, if the data has moved.
        photos: whether to log PSNR in the run's held-out photos; or a folder of photos, with poses
            from ``views`` or from a camera file nearby.
        memory: memory limit, such as "8GB" or 8000 (units of 10^6 bytes); by default the free
            memory. A PLY that needs more is merged in parts.
        jobs: number of processes that share these parts, each within ``memory``.
        spz_version: version of SPZ to which the size of an .spz refers, as for :func:`save`.
        progress: True shows a bar; a function is called with the current task and the share of it
            that is done.

    Returns:
        The smaller scene, with exactly the requested count, on the device of the given scene.

    Raises:
        BudgetError: if the budget cannot be met.
        SceneError: if no Gaussian can be drawn, or the file is not usable.
        DataError: if views are needed and there are none, or most cameras of a file see nothing of
            the scene.
        PointSplatError: if the method is unknown, or an option does not fit it.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::10]  # every tenth Gaussian, to be quick
        >>> len(ps.prune(room, keep=1000)), round(len(ps.prune(room, keep="10%", by="coverage")) / len(room), 2)
        (1000, 0.1)
    """
    options = PruneOptions(
        keep=keep,
        by=by,
        opacity_weight=opacity_weight,
        sh=sh,  # type: ignore[arg-type]
        clean=clean,
        photos=photos,
        poses=_named(views),
        resolution=resolution,
        up=up,
        data=data,
        spz_version=spz_version,  # type: ignore[arg-type]
    )
    done = run.prune(
        scene,
        options,
        views=_given(views),
        memory=_bytes(memory),
        jobs=jobs,
        progress=progress,
    )
    log_report(done.report)
    return done.report.scene


def compact(
    scene: Source,
    keep: Keep | str | None = None,
    refiner: TrainedRefiner | None = None,
    *,
    by: str | None = None,
    sh: str = "all",
    clean: bool = False,
    effort: Effort = "quick",
    seconds: float | None = None,
    photos: bool | str | Path = False,
    target_db: float | None = None,
    target_format: str = ".ply",
    spz_version: int = SPZ_VERSION,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    progress: bool | Progress = False,
) -> Compacted:
    """Make a scene smaller, repair it, and accept the repair by comparing renders.

    A trained refiner, if given, refines the smaller scene. Learned steps then repair it: they bring
    it closer to renders of the given scene, for ``effort`` or ``seconds``. Photos are not needed. A
    refinement or repair that harms pictures of any size is rejected.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        keep: size of the result, as for :func:`prune`; pruning alone reaches an "auto" PSNR. With
            ``photos``, "auto" is the smallest file that loses at most 0.3 dB in held-out photos. By
            default a tenth; with a refiner the budget of its training.
        refiner: trained network from :func:`load_refiner`; by default none.
        by: pruning method, as for :func:`prune`; by default "merge"; with a refiner the method of
            its training.
        sh, clean: as for :func:`prune`.
        effort: length of the repair in steps: 0 ("instant"), 192 ("quick") or 1200 ("thorough"); up
            to four times as many for more than 20,000 Gaussians.
        seconds: duration of the repair, in place of ``effort``. Ctrl-C ends the repair early and
            returns the scene so far.
        photos: train on photos in place of the repair, by 2400 ("quick") or 12000 ("thorough")
            steps, or for ``seconds``; values as for :func:`prune`.
        target_db: minimum PSNR of the final file against renders of the given scene, over the
            pixels that it covers, dB, in place of ``keep``. The smallest such file is searched for.
        target_format: format for a file size or PSNR: ".ply", ".spz", ".sog", ...
        spz_version: version of that .spz, as for :func:`save`.
        views: cameras for comparison, as for :func:`prune`; at most 12 are used. The repair uses
            the others, and samples views if there are too few.
        resolution, up, data, progress: as for :func:`prune`.

    Returns:
        ``.scene``, ``.accepted`` (whether the refinement was), ``.psnr`` (dB against the given
        scene), ``.seconds``, ``.verdict`` (text on the gains), and more: see :class:`Compacted`.

    Raises:
        BudgetError: if the budget or the PSNR cannot be met; the message has the reachable values.
        SceneError: if no Gaussian can be drawn, the file is not usable, or the SH degree exceeds
            the refiner's.
        DataError: if the budget or ``sh`` needs views and there are none.
        PointSplatError: if the method or effort is unknown, or the time is negative.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", seconds=1)
        >>> result.psnr > 15, result.seconds > 0
        (True, True)
    """
    options = CompactOptions(
        keep=keep,
        by=by or "",
        sh=sh,  # type: ignore[arg-type]
        clean=clean,
        target_format=target_format,
        spz_version=spz_version,  # type: ignore[arg-type]
        effort=effort,
        seconds=seconds,
        photos=photos,
        target_db=target_db,
        poses=_named(views),
        resolution=resolution,
        up=up,
        data=data,
    )
    done = run.compact(scene, options, refiner, views=_given(views), progress=progress)
    log_report(done.report)
    return Compacted(**vars(done.report))


class Compacted(Report):
    """The result of :func:`pointsplat_ns.compact`: a smaller scene, and figures of every stage.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", effort="instant")
        >>> result.scene is result.pruned, result.accepted
        (True, False)
    """

    @property
    def verdict(self) -> str:
        """A line of text per stage after pruning: its gain, or the reason to reject it. One line if
        there is no such stage."""
        return verdict_text(self)

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines of text: origin of the views, cut SH bands, cleaning, search."""
        return note_lines(self)


def clean(
    scene: Source,
    strength: float = 0.5,
    *,
    picture: str | Path | None = None,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    progress: bool | Progress = False,
) -> Gaussians:
    """Remove floaters from a scene, and Gaussians that cannot be drawn or are never visible. Needs
    no photos.

    Results (counts, clusters, PSNR after removal) are logged at level INFO.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        strength: strength of the removal of floaters, in [0, 1]. Floaters are Gaussians far in
            front of the visible surfaces that hardly change pictures. 0 removes none.
        picture: PNG file for the scene, the removed Gaussians with a colour per cluster, and the
            result.
        views, resolution, up, data, progress: as for :func:`pointsplat_ns.prune`.

    Returns:
        The remaining Gaussians, at least one, bit for bit and in order, on the device of the given
        scene.

    Raises:
        SceneError: if no Gaussian can be drawn, or a file is not usable.
        PointSplatError: if the strength is not in [0, 1].

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::10]
        >>> len(ps.clean(room)) <= len(room)
        True
    """
    options = ViewOptions(poses=_named(views), resolution=resolution, up=up, data=data)
    done = run.clean(scene, strength, options, views=_given(views), progress=progress)
    if picture is not None:
        plot_cleaning(done, picture)
    log_lines(cleaning_lines(done.cleaning))
    return done.scene


@normal_mode
@outputs_claimed()
def lod(
    scene: Source,
    levels: Sequence[Keep | str] | str = ("50%", "25%", "10%", "3%"),
    *,
    sh: str = "all",
    effort: Effort = "instant",
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    folder: str | Path | None = None,
    stream: bool = False,
    tiles: bool = False,
    at: str | None = None,
    spz_version: int | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> Levels:
    """Make levels of detail: merge a scene to ever fewer Gaussians in one pass, and measure each
    level.

    Each level is merged from the previous one, so levels are nested: every Gaussian has one parent
    in the next coarser level.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        levels: sizes of the levels, as ``keep`` of :func:`prune` except "auto"; in any order.
        sh: SH bands of every level, as for :func:`prune`.
        effort: length of the repair of each level, as for :func:`compact`; Gaussians keep their
            parents.
        views: cameras to compare renders in, as for :func:`prune`; at most 12 are used.
        resolution, up, data, progress: as for :func:`prune`.
        folder: output folder for the levels and a manifest; see :meth:`Levels.save`. A name that
            ends in .rad is a file of all levels for Spark.
        stream: write a streamed SOG instead.
        tiles: write 3D Tiles instead.
        at: place of the tiles on the Earth: UTM zone of the scene's coordinates ("EPSG:32632"), or
            latitude, longitude and height of its origin ("48.86,2.29,35"); by default tiles keep
            the frame of the scene's file.
        spz_version: version of the SPZ in tiles: 3, the newest that CesiumJS reads, or 2; by
            default 3.
        force: overwrite existing files in ``folder``.

    Returns:
        The levels, the finest first, with exactly the requested counts, their quality, and the
        parents of all Gaussians: see :class:`Levels`.

    Raises:
        BudgetError: if a level does not fit the scene, or two levels have the same number of
            Gaussians.
        SceneError: if no Gaussian can be drawn, or a file or the folder is not usable.
        DataError: if ``sh`` needs views and there are none.
        PointSplatError: if ``sh`` or the effort is unknown.

    Example:
        >>> import pointsplat_ns as ps
        >>> levels = ps.lod(ps.example_room()[::20], ["50%", "25%", 100])
        >>> [(len(level.scene), level.quality.psnr > 10) for level in levels]
        [(1572, True), (786, True), (100, True)]
    """
    budgets = parse_levels(levels)  # these checks come before the scene is read
    reduction = PruneOptions(keep=1.0, sh=sh)  # type: ignore[arg-type]
    reduction.check()
    repair = RepairBudget(effort)
    output = LevelOutput.of(folder, stream, tiles, at, up, force, spz_version)
    if output is not None:
        output.check(len(budgets))
    options = ViewOptions(poses=_named(views), resolution=resolution, up=up, data=data)
    options.check()
    subject = read_subject(scene, options, _given(views))
    source = None if isinstance(scene, Gaussians) else source_file(scene)
    with progress_bar(progress) as report:
        made = make_levels(
            subject.dense, budgets, reduction, subject.views(), source, report, repair
        )
        made = made if output is None else output.write(made, report)
    log_lines(made.notes)
    return made


def plot_views(
    scene: Source,
    path: str | Path,
    *,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
) -> str:
    """Draw the views used for decisions on a scene: a sheet of up to 16 pictures.

    Args:
        scene: N Gaussians, or the path of a scene.
        path: PNG file to write.
        views, resolution, up, data: as for :func:`prune`.

    Returns:
        A line of text: number, size and origin of the views.

    Raises:
        SceneError: if the scene is not usable, or the file cannot be written.
        DataError: if there are no views.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     text = ps.plot_views(ps.example_room()[::20], f"{folder}/sheet.png", resolution="64x48")
        >>> "sampled poses" in text
        True
    """
    options = ViewOptions(poses=_named(views), resolution=resolution, up=up, data=data)
    options.check()
    subject = read_subject(scene, options, _given(views))
    return draw_views(subject.dense.detach().to("cpu"), subject.views(), path)


def _named(views: Views | str | Path | None) -> str | Path | None:
    """The path in ``views``; None if there is none."""
    return None if isinstance(views, Views) else views


def _given(views: Views | str | Path | None) -> Views | None:
    """The views in ``views``; None if it is a path."""
    return views if isinstance(views, Views) else None


def _bytes(memory: float | str | None) -> float | None:
    """A memory limit in bytes, from units of 10^6 bytes or text."""
    if memory is None:
        return None
    return 1e6 * (parse_megabytes(memory) if isinstance(memory, str) else memory)
