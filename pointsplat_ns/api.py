"""The public functions that put the parts together. ``import pointsplat_ns as ps`` gives them all.

The command line is a thin layer over these: what it can do, one call here can do.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import Tensor

from pointsplat_ns.compression.compact import Compacted, compact_scene, resolve_options
from pointsplat_ns.compression.level_folder import check_folder
from pointsplat_ns.compression.levels import DEFAULT_LEVELS, Levels, make_levels, parse_levels
from pointsplat_ns.compression.pictures import plot_views as draw_views
from pointsplat_ns.compression.posed_scene import read_posed
from pointsplat_ns.compression.prune import check_options, prune_scene
from pointsplat_ns.compression.repair import Effort, RepairBudget
from pointsplat_ns.compression.trained_refiner import (
    TrainedRefiner,
    load_refiner,
    open_refiner_run,
    scenes_of_run,
)
from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.camera_files import is_camera_file
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.runs import REFINER_METHOD, may_be_run, open_run
from pointsplat_ns.io.scene import read_scene
from pointsplat_ns.io.source import source_file
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.looking.windows import parse_resolution
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.nerfstudio_plugin.measure_tradeoff import subject_of
from pointsplat_ns.pruning import Keep
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.tradeoff.finding import find_scene
from pointsplat_ns.tradeoff.settings import repairs_of
from pointsplat_ns.tradeoff.targets import targets_of
from pointsplat_ns.views import Views

logger = logging.getLogger("pointsplat_ns")

Source = Gaussians | str | Path
"""A dense scene, or where to read it."""

EXAMPLE = Path(__file__).parent / "examples" / "room.ply"
"""The scene that ships."""


def load(path: str | Path, scene: str | None = None) -> Gaussians:
    """Read a scene.

    Args:
        path: a file of a scene (``.ply``, compressed or not, ``.spz``, ``.sog`` or its folder, ``.splat``,
            ``.ksplat``), a Splatfacto ``.ckpt``, a Splatfacto run (its folder or ``config.yml``), or a ``pointsplat``
            run, whose dense scene is then pruned and refined as it was in the training.
        scene: which scene of a ``pointsplat`` run; by default the first that it was not trained on, or the first.

    Returns:
        The scene, float32 on the CPU. Log-scales and logits are kept as the file has them.

    Raises:
        SceneError: if it is none of these, damaged, or has no such scene.

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
    scenes, shown = scenes_of_run(open_refiner_run(path, need_data=True))
    chosen = shown if scene is None else scene
    if chosen not in scenes:
        raise SceneError(f"scene {chosen!r}: no such scene in {path}; there are {', '.join(scenes)}")
    refiner = load_refiner(path)
    settings = refiner.settings
    refined = refine(settings.prune(read_scene(scenes[chosen])), refiner)
    _log((f"{chosen}: pruned by {settings.by} (keep {settings.keep:g}) and refined, as in the training",))
    return refined


def example_room() -> Gaussians:
    """A small scene to try things on: a built-in room that the refiner that ships was not trained on.

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
    fine_tune: int = 0,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    progress: bool | Progress = False,
) -> Gaussians:
    """Make a scene smaller: merge neighbours, or keep the Gaussians that matter, from the scene alone.

    What was found on the way (SH bands dropped, PSNR reached, where views came from) is logged at level INFO.

    Args:
        scene: N Gaussians, or where to read them: a PLY, a checkpoint, or a Splatfacto run.
        keep: how much: a ratio (0.3, "30%"), a count (50000), the size of a PLY ("12MB") or of a file of another format
            ("12MB.spz"), or "auto:35", the smallest scene whose renders reach 35 dB PSNR against those of the given one
            ("auto" alone means 35). For .spz and .sog the count is found by trying.
        by: the method. "merge" replaces neighbours by one Gaussian each; the others keep Gaussians bit for bit:
            "coverage", "paper" (eq. 3), "authors", "opacity", "volume", "log-volume", "area", "random", and
            "lightgaussian" and "pup", which look at the scene from ``views``.
        sh: SH bands to keep: "all", up to a degree ("0" to "3"), or "auto", those without which renders stay within
            40 dB.
        opacity_weight: lambda of "paper", "authors" and "log-volume", in [0, 1]; by default the paper's 0.3.
        clean: first remove what cannot be drawn and what is seen from nowhere; ``keep`` refers to the scene as given.
        fine_tune: steps of optimising what was kept against the given scene's own renders.
        views: where to look from, if anything has to be rendered: views, the run whose dataset has the poses, or a file
            of cameras (``cameras.json`` of 3DGS, ``transforms.json`` of nerfstudio, the folder of a COLMAP model). By
            default those of the run that ``scene`` names, or poses sampled in free space.
        resolution: width and height of the pictures that people look at, pixels: (1920, 1080) or "1920x1080". What is
            decided by rendering is decided at this size. By default that of the photos or of given views, else
            1920 x 1080.
        progress: True shows a bar; a function is called with what is being done and the share done of it.

    Returns:
        Exactly as many Gaussians as ``keep`` means, on the device of the given ones.

    Raises:
        BudgetError: if no such scene can be made.
        SceneError: if no Gaussian can be drawn, or the file is not usable.
        DataError: if views are needed and cannot be had, or most of those of a file see nothing of the scene.
        PointSplatError: if there is no such method, or an option does not fit it.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::10]  # every tenth Gaussian, to be quick
        >>> len(ps.prune(room, keep=1000)), round(len(ps.prune(room, keep="10%", by="coverage")) / len(room), 2)
        (1000, 0.1)
    """
    budget = check_options(keep, by, sh, opacity_weight, fine_tune)  # before the scene is read
    dense, source = _read(scene, views, resolution)
    with progress_bar(progress) as report:
        pruned = prune_scene(dense, budget, by, sh, opacity_weight, source, fine_tune, report, clean)
    _log(pruned.notes)
    return pruned.scene


def refine(scene: Gaussians, refiner: TrainedRefiner | None = None) -> Gaussians:
    """Repair a pruned scene by one forward pass of a trained network.

    The network was trained on scenes pruned as ``refiner.settings`` says, and knows no other kind; :func:`compact`
    checks whether it helps.

    Args:
        scene: K Gaussians.
        refiner: from :func:`load_refiner`; by default the one that ships.

    Returns:
        K Gaussians on the device of the given ones.

    Raises:
        SceneError: if the SH degree exceeds the network's.

    Example:
        >>> import pointsplat_ns as ps
        >>> small = ps.prune(ps.example_room()[::10], keep="10%")
        >>> len(ps.refine(small, ps.load_refiner())) == len(small)
        True
    """
    return (refiner or load_refiner())(scene)


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
    target_db: float | None = None,
    target_ms: float | None = None,
    target_mb: float | None = None,
    target_format: str = ".ply",
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    progress: bool | Progress = False,
) -> Compacted:
    """Make a scene smaller, repair it, and check by rendering how far that helps.

    Learned steps bring the smaller scene closer to the given scene's own renders, no photos, for as long as ``effort``
    or ``seconds`` says. A trained refiner, if one is given, comes before them. What does not bring renders closer in
    pictures of every size is left out.

    With targets, count, SH degree and whether to repair are decided by what the scene needs: the smallest file that has
    ``target_db`` and is within the limits of time and size; among limits alone, the best within them.

    Args:
        scene: N Gaussians, or where to read them: a PLY, a checkpoint, or a Splatfacto run.
        keep: how much, as for :func:`prune`; an "auto" PSNR is met before repairs. By default what the refiner was
            trained with, and a tenth without one.
        refiner: from :func:`load_refiner`; by default none.
        by: the method, as for :func:`prune`; by default the one that the refiner was trained with, and "merge" without
            one.
        sh: SH bands to keep, as for :func:`prune`.
        clean: as for :func:`prune`.
        effort: "instant" takes no steps; "quick" and "thorough" take 48 and 400.
        seconds: repair for so long, instead; Ctrl-C ends it earlier, and what has been reached is kept.
        target_db: least PSNR against the given scene's renders, dB, mean over views; those of held-out photos where the
            run's are found.
        target_ms: longest time of a frame, milliseconds, drawn by this package in these views.
        target_mb: largest file, in units of 10^6 bytes.
        target_format: of the file whose size counts, as the end of its name: ".ply", ".spz", ".sog", ...
        views: where renders are compared, as for :func:`prune`; at most 12 are taken. If there are more than twice as
            many, the scene is repaired from the others, else on views sampled in free space.
        resolution: as for :func:`prune`.
        progress: True shows a bar; a function is called with what is being done and the share done of it.

    Returns:
        ``.scene``, ``.accepted`` (whether the refiner is in it), ``.psnr`` (dB against the given scene's renders),
        ``.seconds``, ``.verdict`` (all of that in a line), and more: see :class:`Compacted`. ``.target`` says what was
        found for targets, and what the next cheaper scene would have missed.

    Raises:
        BudgetError: if no such scene can be made; of targets, the text says what can.
        SceneError: if no Gaussian can be drawn, the file is not usable, or the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs views and none can be had.
        PointSplatError: if there is no such method or effort, or the time is negative.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", seconds=1)
        >>> result.psnr > 15, result.seconds > 0
        (True, True)
    """
    budget = RepairBudget(effort, seconds)
    _, method = resolve_options(refiner, keep, by, sh)  # before the scene is read
    targets = targets_of(target_db, target_ms, target_mb, keep, sh, clean, seconds)
    format_to_write(target_format)
    dense, source = _read(scene, views, resolution)
    with progress_bar(progress) as report:
        if targets is None:
            result = compact_scene(dense, refiner, keep, by, sh, source, report, clean, budget)
        else:
            given = views if isinstance(views, Views) else source.given
            size = parse_resolution(resolution)
            subject = subject_of(dense, _run_of(scene, views), given, refiner, target_format, size)
            result = find_scene(subject, targets, method, repairs_of(effort), report)
    _log((*result.target.splitlines(), *result.verdict.splitlines(), *result.notes))
    return result


def lod(
    scene: Source,
    levels: Sequence[Keep | str] | str = DEFAULT_LEVELS,
    *,
    sh: str = "all",
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    folder: str | Path | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> Levels:
    """Make levels of detail: a scene merged to fewer and fewer Gaussians in one pass, the error of each measured.

    Each level is merged from the one before, so levels are nested: every Gaussian has one parent in the next coarser
    level.

    Args:
        scene: N Gaussians, or where to read them: a PLY, a checkpoint, or a Splatfacto run.
        levels: how much each level keeps, as for :func:`prune` but for "auto"; in any order.
        sh: SH bands of every level, as for :func:`prune`.
        views: where renders are compared, as for :func:`prune`; at most 12 are taken.
        resolution: as for :func:`prune`.
        folder: where to write each level as soon as it is there, a manifest and a picture; see :meth:`Levels.save`.
        force: overwrite existing files in ``folder``.
        progress: True shows a bar; a function is called with what is being done and the share done of it.

    Returns:
        The levels, the finest first, with exactly as many Gaussians as asked for; their errors, and the parents of
        each Gaussian: see :class:`Levels`.

    Raises:
        BudgetError: if a level does not fit the scene, or two mean the same number of Gaussians.
        SceneError: if no Gaussian can be drawn, or a file or the folder is not usable.
        DataError: if ``sh`` needs views and none can be had.
        PointSplatError: if there is no such ``sh``.

    Example:
        >>> import pointsplat_ns as ps
        >>> levels = ps.lod(ps.example_room()[::20], ["50%", "25%", 100])
        >>> [(len(level.scene), level.errors.near.psnr > 10) for level in levels]
        [(1572, True), (786, True), (100, True)]
    """
    budgets = parse_levels(levels)  # this and the next before the scene is read
    check_options(1.0, "merge", sh)
    if folder is not None:
        check_folder(Path(folder), len(budgets), force)
    dense, view_source = _read(scene, views, resolution)
    source = None if isinstance(scene, Gaussians) else source_file(scene)
    with progress_bar(progress) as report:
        made = make_levels(dense, levels, sh, view_source, source, folder, force, report)
    _log(made.notes)
    return made


def plot_views(
    scene: Source,
    path: str | Path,
    *,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
) -> str:
    """Draw the views that decisions about a scene are made in: a sheet of up to 16 pictures.

    Args:
        scene: N Gaussians, or where to read them.
        path: the PNG file to write.
        views: as for :func:`prune`.
        resolution: as for :func:`prune`.

    Returns:
        Text: where the views come from, what is taken to be up, and what share of the visible content they show.

    Raises:
        SceneError: if the scene is not usable, or the file cannot be written.
        DataError: if there are no views.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     text = ps.plot_views(ps.example_room()[::20], f"{folder}/sheet.png", resolution="64x48")
        >>> "of the visible content" in text
        True
    """
    dense, source = _read(scene, views, resolution)
    return draw_views(dense.detach().to("cpu"), source, path)


def lpips(pred: Tensor, target: Tensor, net: Literal["alex", "vgg"] = "alex") -> Tensor:
    """LPIPS, the perceptual distance of images (Zhang et al. 2018).

    The backbone's weights are downloaded by torchvision when they are first needed, or taken from the folder or file
    that the environment variable ``POINTSPLAT_LPIPS_WEIGHTS`` names.

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1]; at least 31 pixels a side for "alex", 16 for "vgg".
        target: the same shape.
        net: "alex" is what most papers report, "vgg" what most losses use.

    Returns:
        A scalar, or (B,); 0 for identical images. Differentiable.

    Raises:
        LpipsUnavailable: if the weights cannot be had; the text says why.
        ImageError: if the images cannot be compared.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> image = ps.render(room, ps.sample_views(room, 1)[0])
        >>> float(ps.lpips(image, image))  # doctest: +SKIP
        0.0
    """
    from pointsplat_ns.metrics.lpips import cached_lpips

    return cached_lpips(net, pred.device)(pred, target)


def _read(
    scene: Source, views: Views | str | Path | None, resolution: tuple[int, int] | str | None
) -> tuple[Gaussians, ViewSource]:
    """The Gaussians to make fewer, and where renders of them are compared.

    A ``pointsplat`` run is refused: its scene has been pruned already.
    """
    size = parse_resolution(resolution)
    if isinstance(views, (str, Path)) and not Path(views).exists():
        raise SceneError(
            f"{views}: no such file or folder; expected views, a run whose dataset has the poses, or a file of cameras"
        )
    if isinstance(views, (str, Path)) and is_camera_file(views):
        dense, views = read_posed(scene, views)
        return dense, ViewSource(dense, given=views, resolution=size)
    dense = scene if isinstance(scene, Gaussians) else read_scene(scene)
    if isinstance(views, Views):
        return dense, ViewSource(dense, given=views, resolution=size)
    return dense, ViewSource(dense, run=_run_of(scene, views), dataset_views=dataset_views, resolution=size)


def _run_of(scene: Source, views: Views | str | Path | None) -> Path | None:
    """The file or folder whose dataset may have the poses."""
    named = scene if views is None else views
    return Path(named) if isinstance(named, (str, Path)) else None


def _is_refiner_run(path: str | Path) -> bool:
    try:
        return may_be_run(path) and open_run(path, need_data=False).method_name == REFINER_METHOD
    except SceneError:
        return False  # a scene that stands alone, or nothing that can be read: who reads it says which


def _log(lines: tuple[str, ...]) -> None:
    for line in lines:
        logger.info("%s", line)
