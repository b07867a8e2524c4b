"""``pointsplat compact``: make a scene smaller and repair it in one go."""

from __future__ import annotations

import shlex
from dataclasses import asdict, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple
from urllib.parse import quote

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import (
    print_if_larger,
    print_json,
    print_result,
    scene_result,
    written_size,
)

if TYPE_CHECKING:
    from pointsplat_ns.compression.quality import Quality
    from pointsplat_ns.folders import SceneResult

GoalName = Literal["web", "phone", "headset", "email"]


class Goal(NamedTuple):
    """What a purpose asks for."""

    suffix: str | None = None
    """Suffix of the file; None for that of the scene."""
    keep: str | None = None
    """Budget; None for the usual one."""
    page: bool = False
    """Whether a page with the scene alone is written beside the file."""
    page_mb: float = 60.0
    """Largest page, in units of 10^6 bytes."""
    use: str = "to fly through in a browser"
    """Text on the use of a page."""


GOALS: dict[GoalName | None, Goal] = {
    None: Goal(),
    "web": Goal(
        ".sog",
        "2MB",
        True,
        use="to upload; paste this where the scene is to appear:\n"
        '<iframe src="{url}" title="{name}" style="width: 100%; height: 30rem; border: 0" '
        "allowfullscreen></iframe>",
    ),
    "phone": Goal(".sog", "500000gaussians"),
    "headset": Goal(".spz", "400000gaussians"),
    "email": Goal(".spz", "5MB", True, 10.0, "to fly through after a double click, also offline"),
}
"""Sources of the figures: docs/guides/downloaded_splat.md."""


def compact(
    scene: options.Scenes,
    output: options.Output = None,
    goal: Annotated[GoalName | None, tyro.conf.arg(name="for")] = None,
    keep: str | None = None,
    refiner: Path | None = None,
    by: str | None = None,
    sh: options.Bands = "all",
    clean: bool = False,
    effort: Literal["instant", "quick", "thorough"] = "quick",
    seconds: float | None = None,
    photos: options.Photos = False,
    target_db: float | None = None,
    poses: options.Poses = None,
    resolution: options.Resolution = None,
    up: options.Up = None,
    data: options.Data = None,
    picture: Path | None = None,
    html: Path | None = None,
    force: options.Force = False,
    jobs: options.Jobs = None,
    verbose: options.Verbose = False,
    json_output: options.Json = False,
) -> None:
    """Make any scene smaller and repair it, or all scenes of a folder. No photos are needed.

    Neighbours are merged; with --refiner a network refines the result in one pass; then learned
    steps repair it: they bring it closer to renders of the dense scene. Each change is compared in
    other views, and left out if it harms pictures of any size. Views are those of --poses, else
    those of the run's dataset; if there are none, they are sampled.

    A folder with config.yml is a run: one scene. Any other folder is a folder of scenes: all files
    with Gaussians below it, and the newest Splatfacto run of each experiment. Finished scenes are
    skipped, so the same command continues after an interruption.

    Args:
        output: the file to write, of any format as for prune; by default in the format of the scene
            and beside it: room_compact.ply for room.ply, compact.ply in the folder of a run. For a
            folder of scenes, another folder; by default rooms_compact beside rooms. Each result
            there has the format of its scene.
        goal: the purpose, in place of --keep and the format: web (a .sog of 2 MB, and a page with
            the scene to paste into another), phone (a .sog of at most 500,000 Gaussians), headset
            (an .spz of at most 400,000), email (an .spz of 5 MB, and a page that opens with a
            double click). --keep, --target-db and --html replace its parts.
        keep: size of the result, as for prune: 0.1, 10%, 50000, 12MB, or auto:35, which is reached
            before repairs. With --photos, auto is the smallest file that loses at most 0.3 dB in
            held-out photos. By default the budget of the refiner's training; without a refiner 0.1.
        refiner: a trained network that refines the scene before the steps: a pointsplat run (its
            folder or config.yml), a .safetensors file, or shipped; by default none.
        by: the method of prune; by default the method of the refiner's training; without a refiner
            merge.
        sh: SH bands to keep, as for prune: all, up to a degree, or auto.
        clean: as for prune: first remove Gaussians that cannot be drawn or seen.
        effort: length of the repair: no steps (instant), 192 (quick), or 1200 (thorough); up to
            four times as many for more than 20,000 Gaussians.
        seconds: duration of the repair, in place of --effort; by default none is set. Ctrl-C ends
            it earlier and writes the scene so far.
        photos: in place of the repair train on photos, by 2400 steps (quick) or 12000 (thorough),
            or for --seconds. Photos in and outside of the steps say whether it helped. For a run,
            those of its dataset; for any scene, those in FOLDER, with the poses of --poses, or of a
            file of cameras there, above it or beside the scene.
        target_db: in place of --keep, the smallest file that has at least this PSNR against renders
            of the dense scene, after all repairs; by default none is searched for.
        picture: a .png file for images of some views: dense, before and after the repair, side by
            side; for a folder, all scenes before and after; by default none.
        html: an .html file that opens offline in a browser, to fly through the scene before and
            after, with a wipe between them; for a folder, a gallery of all scenes before and after;
            by default none.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.io.scene import is_folder_of_scenes

    chosen = GOALS[goal]
    unasked = goal is None and keep is None and refiner is None and target_db is None
    keep = chosen.keep if keep is None and target_db is None else keep
    if is_folder_of_scenes(scene):
        from pointsplat_ns.folders import output_folder

        for name, given in {"--poses": poses, "--up": up, "--photos": photos}.items():
            if given is not None and given is not False:
                raise ps.SceneError(f"{name} is for one scene; {scene} is a folder of scenes")
        folder = output or output_folder(scene)
        results = ps.compact_folder(
            scene,
            folder,
            keep,
            refiner,
            by=by,
            sh=sh,
            clean=clean,
            effort=effort,
            seconds=seconds,
            target_db=target_db,
            resolution=resolution,
            data=data,
            target_format=chosen.suffix,
            html=html,
            picture=picture,
            jobs=1 if jobs is None else jobs,
            force=force,
            progress=True,
        )
        return _print_folder(
            results, folder, [path for path in (html, picture) if path is not None], json_output
        )
    if jobs is not None:
        raise ps.SceneError(f"{scene}: one scene; --jobs is for a folder of scenes")
    from pointsplat_ns.compacting import Looking, compact_source
    from pointsplat_ns.compression.quality import judge_of, quality_of_file
    from pointsplat_ns.compression.requests import CompactRequest, RepairBudget
    from pointsplat_ns.io.formats import format_to_write
    from pointsplat_ns.io.runs import name_of

    options.check_poses(poses)
    if (
        output is not None
        and chosen.suffix is not None
        and not output.name.lower().endswith(chosen.suffix)
    ):
        raise ps.SceneError(
            f"{output}: --for {goal} writes {chosen.suffix}; expected such a name, or --keep in "
            "place of --for"
        )
    output = output or options.output_beside(scene, goal or "compact", chosen.suffix)
    alone = chosen.page and html is None
    html = output.with_suffix(".html") if alone else html
    options.check_outputs(output, force, picture, html)
    budget = RepairBudget(effort, seconds)
    suffix = format_to_write(output).suffix
    trained = None if refiner is None else ps.load_refiner(refiner, by=by)
    request = CompactRequest.of(
        trained, keep, by, sh, clean, budget, bool(photos), suffix, target_db
    )
    unfinished = output.with_name(f".{output.name}.unfinished")
    request = replace(request, unfinished=unfinished)
    looking = Looking(poses, resolution, up, data, photos)
    dense, result, source = compact_source(scene, request, looking, progress=True)
    ps.save(result.scene, output, progress=True, overwrite=True)
    unfinished.unlink(missing_ok=True)
    quality = quality_of_file(result.judge or judge_of(dense, source), result.scene, output)
    if quality is not None:
        quality = replace(quality, photos=result.photo_gain)
    files = [_file_text(scene), _file_text(output)]
    shown = None if picture is None else ps.plot_comparison(dense, result, picture, files, quality)
    if html is not None:
        names = None if alone else [f"dense ({files[0]})", f"compact ({files[1]})"]
        notes = [] if alone or quality is None else [f"{quality}"]
        sampled = any(
            note.startswith("views: sampled") for note in result.notes
        )  # the page opens better without these
        ps.write_page(
            [dense, result.scene][alone:],
            html,
            names,
            title=name_of(scene),
            notes=notes,
            views=None if sampled else result.views,
            up=up,
            limit_mb=chosen.page_mb,
            progress=True,
        )
    if json_output:
        made = {
            "refined": result.accepted,
            "repaired": result.repair_accepted,
            **(quality.as_dict() if quality else {"psnr": None}),
            "picture": picture,
            "html": html,
        }
        print_json({**scene_result(len(dense), result.scene, result.seconds, output), **made})
    else:
        also = ["refined"] * result.accepted + ["repaired"] * result.repair_accepted
        also += ["trained on photos"] * (result.last.photos is not None)
        print_result(
            request.prune.by, also, len(dense), result.scene, result.seconds, output, quality
        )
        print_if_larger(scene, output)
        if verbose and quality is not None:
            print(quality.details)
        if shown is not None:
            print(shown)
        _print_use(goal, html, name_of(scene), quality)
    if result.interrupted:
        raise KeyboardInterrupt  # once the best result so far is written and printed
    if unasked and not json_output:
        _print_next(scene, output, quality)


def _print_folder(
    results: list[SceneResult], folder: Path, shown: list[Path], json_output: bool
) -> None:
    """Print a table of the scenes of a folder, or JSON. Raises PointSplatError if one has
    failed."""
    from pointsplat_ns.errors import PointSplatError
    from pointsplat_ns.io.discovery import FOLDER_FILES
    from pointsplat_ns.system.terminal import print_table

    failed = sum(result.status == "failed" for result in results)
    if json_output:
        print_json({"output": folder, "scenes": [asdict(result) for result in results]})
    else:
        forms = (",", ",", ".2f", ".1f", ".1f")
        rows = []
        for result in results:
            numbers = (result.before, result.after, result.megabytes, result.psnr, result.seconds)
            cells = (
                "-" if value is None else f"{value:{form}}"
                for value, form in zip(numbers, forms, strict=True)
            )
            said = result.error or result.note
            rows.append(
                (result.name, *cells, f"{result.status}: {said}" if said else result.status)
            )
        header = ("scene", "before", "after", "MB", "dB", "seconds", "status")
        print_table(header, rows, "dB: PSNR against the scene's own renders", left=(0, 6))
        print(
            f"{folder}: {len(results) - failed} of {len(results)} scenes, and the table "
            f"{FOLDER_FILES.scenes_table}"
        )
        for path in shown:
            print(f"{path}: all scenes before and after")
    if failed:
        raise PointSplatError(
            f"{failed} of {len(results)} scenes failed; the same command tries them again"
        )


def _file_text(path: Path) -> str:
    """Name and size of a scene's file or SOG folder; the name alone of a run."""
    from pointsplat_ns.io.formats import SOG_META
    from pointsplat_ns.io.runs import name_of

    file = path / SOG_META if path.is_dir() else path
    return (
        f"{path.name}, {written_size(file)}"
        if file.is_file() and file.suffix != ".yml"
        else name_of(path)
    )


def _print_use(
    goal: GoalName | None, page: Path | None, name: str, quality: Quality | None
) -> None:
    """Print what a page of the scene called ``name`` is for; for a headset, also the fill, which
    can slow it."""
    if page is not None:
        use = GOALS[goal].use.format(url=quote(page.name), name=escape(name))
        print(f"{page}: {written_size(page)}, {use}")
    if goal == "headset" and quality is not None:
        fill = f"{quality.fill_before:.1f} -> {quality.fill:.1f} Gaussians drawn per pixel"
        print(f"fill: {fill}; where it is too slow near things, a smaller --keep lowers it")


def _print_next(scene: Path, output: Path, quality: Quality | None) -> None:
    """Print two commands to try after a budget that nobody chose: a look at the result, and another
    budget where its PSNR asks for one, else a goal."""
    share = (
        "30%"
        if quality is not None and quality.psnr < 27.0
        else "3%"
        if quality and quality.psnr > 35.0
        else None
    )
    other = (
        ["--for", "web"]
        if share is None
        else ["--keep", share, "-o", str(options.output_beside(scene, share[:-1]))]
    )
    commands = (
        ["pointsplat", "view", str(scene), str(output)],
        ["pointsplat", "compact", str(scene), *other],
    )
    print("next: " + "\n      ".join(map(shlex.join, commands)))
