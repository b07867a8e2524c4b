"""The public functions on whole scenes; ``import pointsplat_ns as ps`` has them all.

Each command of the command line calls one of these functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.pipeline.options import CompactRequest, Effort, PruneRequest, RepairBudget
from pointsplat_ns.pipeline.report import Compacted
from pointsplat_ns.pipeline.requests import (
    Looking,
    Source,
    compact_source,
    log,
    prune_source,
    read_source,
)
from pointsplat_ns.pipeline.trained_refiner import (
    TrainedRefiner,
    load_refiner,
    open_refiner_run,
    refine,
    scenes_of_run,
)
from pointsplat_ns.pruning import Keep
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene, source_file
from pointsplat_ns.scene.runs import may_be_run, open_run
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.outputs import outputs_claimed
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.tools.comparison_plots import plot_views as draw_views
from pointsplat_ns.tools.levels.levels import LevelOutput, Levels, make_levels, parse_levels

EXAMPLE = Path(__file__).parent / "examples" / "room.ply"
"""The shipped example scene."""


def load(path: str | Path, scene: str | None = None, data: str | Path | None = None) -> Gaussians:
    """Read a scene.

    Args:
        path: a file of a scene (``.ply``, compressed or not, ``.spz``, ``.sog`` or its folder,
            ``.splat``), a checkpoint of Splatfacto or gsplat, a Splatfacto run (its folder or
            ``config.yml``), or a ``pointsplat`` run, whose dense scene is then pruned and refined
            as in its training.
        scene: name of a scene of a ``pointsplat`` run; by default the first held-out one, or else
            the first.
        data: folder of the scenes of a ``pointsplat`` run, if they are no longer where the run
            says.

    Returns:
        The scene, float32 on the CPU. Log-scales and logits are those of the file.

    Raises:
        SceneError: if the path is none of these, is damaged, or has no such scene.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[:100], f"{folder}/some.ply")
        ...     len(ps.load(f"{folder}/some.ply"))
        100
    """
    if not _is_refiner_run(path):
        if scene is not None:
            raise SceneError(f"scene {scene!r}: {path} holds one scene; leave the name out")
        return read_scene(path)
    scenes, default = scenes_of_run(open_refiner_run(path, need_data=True, data=data))
    chosen = default if scene is None else scene
    if chosen not in scenes:
        raise SceneError(
            f"scene {chosen!r}: no such scene in {path}; there are {', '.join(scenes)}"
        )
    refiner = load_refiner(path)
    settings = refiner.settings
    refined = refine(settings.prune(read_scene(scenes[chosen])), refiner)
    log(
        (
            f"{chosen}: pruned by {settings.by} (keep {settings.keep:g}) and refined, as in the "
            "training",
        )
    )
    return refined


def example_room() -> Gaussians:
    """A small built-in scene: a room that the shipped refiner was not trained on.

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
    progress: bool | Progress = False,
) -> Gaussians:
    """Make a scene smaller: merge neighbours, or keep the most important Gaussians. No photos are
    needed.

    Findings (SH bands dropped, PSNR reached, the origin of views) are logged at level INFO.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        keep: size of the result: a ratio (0.3, "30%"), a count (50000), the size of a PLY ("12MB")
            or of a file of another format ("12MB.spz"), or "auto:35", the smallest scene whose
            renders reach 35 dB PSNR against those of the given scene ("auto" alone means 35). For
            .spz and .sog the count is searched.
        by: the method. "merge" replaces neighbours by one Gaussian each; the others keep Gaussians
            bit for bit: "coverage", "paper" (eq. 3), "authors", "opacity", "random", and
            "lightgaussian" and "pup", which score Gaussians in ``views``.
        sh: SH bands to keep: "all", up to a degree ("0" to "3"), or "auto", the lowest degree whose
            renders reach 40 dB.
        opacity_weight: lambda of "paper" and "authors", in [0, 1]; by default the paper's 0.3.
        clean: first remove Gaussians that cannot be drawn or seen; ``keep`` refers to the scene as
            given.
        views: cameras for all rendering: views, the run whose dataset has the poses, or a file of
            cameras (``cameras.json`` of 3DGS, ``transforms.json`` of nerfstudio, the folder of a
            COLMAP model). By default those of the run at ``scene``, or sampled poses.
        resolution: width and height of the pictures that people look at, pixels: (1920, 1080) or
            "1920x1080". Decisions by rendering are made at this size. By default the size of the
            photos or of given views, else 1920 x 1080.
        up: the axis that is up in the scene, "z" or "-y", for sampled views; by default the scene's
            own, or estimated.
        data: folder of the run's photos and poses, or one above it, if it is no longer where the
            run says.
        photos: whether to log PSNR in a run's held-out photos; or a folder of photos, with poses in
            ``views``, or near.
        progress: True shows a bar; a function is called with the current task and the share of it
            that is done.

    Returns:
        Exactly the number of Gaussians of ``keep``, on the device of the given scene.

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
    request = PruneRequest(keep, by, sh, opacity_weight, clean)
    return prune_source(scene, request, Looking(views, resolution, up, data, photos), progress)[1]


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
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    progress: bool | Progress = False,
) -> Compacted:
    """Make a scene smaller, repair it, and accept the repair by comparing renders.

    A trained refiner, if given, refines the smaller scene. Learned steps then bring it closer to
    renders of the given scene, for the duration of ``effort`` or ``seconds``. No photos are needed.
    A refinement or repair that harms pictures of any size is left out.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        keep: size of the result, as for :func:`prune`; an "auto" PSNR is reached before repairs.
            With ``photos``, "auto" is the smallest file that loses at most 0.3 dB in held-out
            photos. By default the budget of the refiner's training, or a tenth without a refiner.
        refiner: from :func:`load_refiner`; by default none.
        by: the method, as for :func:`prune`; by default that of the refiner's training, or "merge".
        sh, clean: as for :func:`prune`.
        effort: "instant" takes no steps; "quick" and "thorough" take 192 and 1200, up to four times
            as many for more than 20,000 Gaussians.
        seconds: duration of the repair, in place of ``effort``; Ctrl-C ends it earlier and keeps
            the scene so far.
        photos: train on photos in place of the repair, named as for :func:`prune`, by 2400
            ("quick") or 12000 ("thorough") steps, or for ``seconds``.
        target_db: in place of ``keep``, least PSNR of the file, after all repairs, against the
            given scene's renders, over the pixels that it covers, dB. The smallest such file is
            searched for.
        target_format: format of the file whose size or PSNR counts: ".ply", ".spz", ".sog", ...
        views: cameras to compare renders in, as for :func:`prune`; at most 12 are used. The repair
            uses the others if there are more than twice as many; else it samples views.
        resolution, up, data, progress: as for :func:`prune`.

    Returns:
        ``.scene``, ``.accepted`` (whether the refiner is in it), ``.psnr`` (dB against the given
        scene's renders), ``.seconds``, ``.verdict`` (text on the gains), and more: see
        :class:`Compacted`.

    Raises:
        BudgetError: if the budget or the PSNR cannot be met; the text tells the reachable values.
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
    on_photos = photos is not False
    format_to_write(target_format)
    request = CompactRequest.of(
        refiner,
        keep,
        by,
        sh,
        clean,
        RepairBudget(effort, seconds),
        on_photos,
        target_format,
        target_db,
    )
    return compact_source(scene, request, Looking(views, resolution, up, data, photos), progress)[1]


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
    force: bool = False,
    progress: bool | Progress = False,
) -> Levels:
    """Make levels of detail: a scene merged to ever fewer Gaussians in one pass, with the error of
    each level.

    Each level is merged from the level before, so levels are nested: every Gaussian has one parent
    in the next coarser level.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        levels: sizes of the levels, as ``keep`` of :func:`prune` except "auto"; in any order.
        sh: SH bands of every level, as for :func:`prune`.
        effort: length of a repair of each level, as for :func:`compact`; its Gaussians keep their
            parents.
        views: cameras to compare renders in, as for :func:`prune`; at most 12 are used.
        resolution, up, data, progress: as for :func:`prune`.
        folder: output folder for the levels and a manifest; see :meth:`Levels.save`. A name that
            ends in .rad is a file of all levels for Spark.
        stream: write a streamed SOG instead.
        tiles: write 3D Tiles instead.
        at: where tiles lie on the Earth: the UTM zone of the scene's coordinates ("EPSG:32632"), or
            the latitude, longitude and height of its origin ("48.86,2.29,35"); by default they have
            the frame of the scene's file.
        force: overwrite existing files in ``folder``.

    Returns:
        The levels, the finest first, with exactly the requested numbers of Gaussians; their errors,
        and the parent of each Gaussian: see :class:`Levels`.

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
    request = PruneRequest(1.0, sh=sh)
    repair = RepairBudget(effort)
    output = LevelOutput.of(folder, stream, tiles, at, up, force)
    if output is not None:
        output.check(len(budgets))
    dense, view_source = read_source(scene, Looking(views, resolution, up, data))
    source = None if isinstance(scene, Gaussians) else source_file(scene)
    with progress_bar(progress) as report:
        made = make_levels(dense, budgets, request, view_source, source, report, repair)
        made = made if output is None else output.write(made, report)
    log(made.notes)
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
    """Draw the views that decide about a scene: a sheet of up to 16 pictures.

    Args:
        scene: N Gaussians, or the path of a scene.
        path: the PNG file to write.
        views, resolution, up, data: as for :func:`prune`.

    Returns:
        A line of text: how many views there are, and their origin.

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
    dense, source = read_source(scene, Looking(views, resolution, up, data))
    return draw_views(dense.detach().to("cpu"), source, path)


def _is_refiner_run(path: str | Path) -> bool:
    try:
        return may_be_run(path) and open_run(path, need_data=False).is_refiner
    except SceneError:
        return False  # a single scene, or not readable: read_scene raises the error
