"""``pointsplat compact``: make a scene smaller and repair it."""

from __future__ import annotations

import shlex
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple
from urllib.parse import quote

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import (
    print_folder,
    print_if_larger,
    print_json,
    print_result,
    scene_result,
    written_size,
)
from pointsplat_ns.pipeline.options import CompactOptions, SpzVersion
from pointsplat_ns.system.terminal import say

if TYPE_CHECKING:
    from pointsplat_ns.pipeline.quality import Quality
    from pointsplat_ns.pipeline.report import Report

GoalName = Literal["web", "phone", "headset", "email"]


class Goal(NamedTuple):
    """Format, size and page for a purpose."""

    suffix: str | None = None
    """Suffix of the file; None for the format of the scene."""
    keep: str | None = None
    """Budget; None for the default."""
    page: bool = False
    """Whether to write a page with only the result beside the file."""
    page_mb: float = 60.0
    """Maximum size of the page, 10^6 bytes."""
    use: str = "to fly through in a browser"
    """Text on the use of the page."""
    spz_version: SpzVersion | None = None
    """Version of an .spz; None for the default."""


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
    "headset": Goal(".spz", "400000gaussians", spz_version=3),
    "email": Goal(".spz", "5MB", True, 10.0, "to fly through after a double click, also offline"),
}
"""Sources of the figures: docs/guides/downloaded_splat.md."""


def compact(
    scene: options.Scenes,
    how: options.Flat[CompactOptions],
    output: options.Output = None,
    goal: Annotated[GoalName | None, tyro.conf.arg(name="for")] = None,
    picture: Path | None = None,
    html: Path | None = None,
    force: options.Force = False,
    jobs: options.Jobs = None,
    cluster: options.Cluster = None,
    verbose: options.Verbose = False,
    json_output: options.Json = False,
) -> None:
    """Make a scene smaller and repair it, or all scenes of a folder. Needs no photos.

    Neighbours are merged. With --refiner, a network refines the result in one pass. Then learned
    steps repair it: they bring it closer to renders of the dense scene. Every change is checked in
    other views, and rejected if it harms pictures of any size. Views come from --poses, else from
    the run's dataset, else they are sampled.

    A folder with config.yml is a run, with one scene. Any other folder is a folder of scenes: all
    files with Gaussians below it, and the newest Splatfacto run of each experiment. Finished scenes
    are skipped, so the same command continues after an interruption.

    Args:
        output: file to write, of any format as for prune; by default beside the scene, in its
            format: room_compact.ply for room.ply, compact.ply in the folder of a run. For a folder
            of scenes, another folder; by default rooms_compact beside rooms, with results in the
            formats of their scenes.
        goal: purpose, in place of --keep and a format: web (a .sog of 2 MB, and a page to embed in
            a web site), phone (a .sog of at most 500,000 Gaussians), headset (an .spz of version 3
            of at most 400,000), email (an .spz of 5 MB, and a page that opens with a double click).
            --keep, --target-db, --spz-version and --html override its parts.
        picture: .png file with some views of the dense scene and of the scene before and after the
            repair, side by side; for a folder, all scenes before and after; by default none.
        html: .html file to fly through the scene before and after, offline in a browser, with a
            wipe between them; for a folder, a gallery of all scenes before and after; by default
            none.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.scene.reading import is_folder_of_scenes

    purpose = GOALS[goal]
    default_budget = (
        goal is None and how.keep is None and how.refiner is None and how.target_db is None
    )
    if how.keep is None and how.target_db is None:
        how = replace(how, keep=purpose.keep)
    if how.spz_version is None:
        how = replace(how, spz_version=purpose.spz_version)
    if is_folder_of_scenes(scene):
        return _compact_folder(
            scene, how, output, purpose, picture, html, force, jobs, cluster, json_output
        )
    for option, given in (("--jobs", jobs), ("--cluster", cluster)):
        if given is not None:
            raise ps.SceneError(f"{scene}: a single scene; {option} is for a folder of scenes")
    from pointsplat_ns.pipeline import run
    from pointsplat_ns.pipeline.quality import quality_of_file
    from pointsplat_ns.scene.formats import format_to_write
    from pointsplat_ns.system.outputs import remove_own, unnamed
    from pointsplat_ns.tools.wording import log_report, quality_details

    options.check_poses(how.poses)
    suffix = purpose.suffix or ""
    if output is not None and not output.name.lower().endswith(suffix):
        raise ps.SceneError(
            f"{output}: --for {goal} writes {purpose.suffix}; expected that suffix, or --keep in "
            "place of --for"
        )
    output = output or options.output_beside(scene, goal or "compact", purpose.suffix)
    alone = purpose.page and html is None
    html = unnamed(output.with_suffix(".html")) if alone else html
    options.check_outputs(output, force, picture, html)
    refiner = None if how.refiner is None else ps.load_refiner(how.refiner, by=how.by or None)
    how = replace(how, target_format=format_to_write(output).suffix)
    state_file = output.with_name(f".{output.name}.unfinished")
    done = run.compact(scene, how, refiner, state_file=state_file, progress=True)
    log_report(done.report)
    report = done.report
    ps.save(report.scene, output, progress=True, overwrite=True, spz_version=how.spz)
    remove_own(state_file)
    quality = quality_of_file(done.judge, report.scene, output)
    if quality is not None:
        quality = replace(quality, photos=report.photo_gain)
    files = [_file_text(scene), _file_text(output)]
    shown = None
    if picture is not None:
        assert report.dense is not None
        shown = ps.plot_comparison(report.dense, report, picture, files, quality)
    if html is not None:
        _write_page(scene, report, html, files, quality, alone, how.up, purpose.page_mb)
    if json_output:
        _print_json(report, output, quality, picture, html)
    else:
        _print_result(report, output, quality)
        print_if_larger(scene, output)
        if verbose and quality is not None:
            say(quality_details(quality))
        if shown is not None:
            say(shown)
        _print_use(goal, html, scene, quality)
    if report.interrupted:
        raise KeyboardInterrupt  # once the best result so far is written and printed
    if default_budget and not json_output:
        _print_next(scene, output, quality)


def _compact_folder(
    scene: Path,
    how: CompactOptions,
    output: Path | None,
    purpose: Goal,
    picture: Path | None,
    html: Path | None,
    force: bool,
    jobs: int | None,
    cluster: str | None,
    json_output: bool,
) -> None:
    """Compact all scenes of a folder, and print a table of the results."""
    import pointsplat_ns as ps
    from pointsplat_ns.tools.folders import output_folder

    for name, given in {"--poses": how.poses, "--up": how.up, "--photos": how.photos}.items():
        if given is not None and given is not False:
            raise ps.SceneError(f"{name} is for one scene; {scene} is a folder of scenes")
    folder = output or output_folder(scene)
    results = ps.compact_folder(
        scene,
        folder,
        how.keep,
        how.refiner,
        by=how.by,
        opacity_weight=how.opacity_weight,
        sh=how.sh,
        clean=how.clean,
        effort=how.effort,
        seconds=how.seconds,
        target_db=how.target_db,
        resolution=how.resolution,
        data=how.data,
        target_format=purpose.suffix,
        spz_version=how.spz,
        html=html,
        picture=picture,
        jobs=1 if jobs is None else jobs,
        cluster=cluster,
        force=force,
        progress=True,
    )
    print_folder(results, folder, [path for path in (html, picture) if path], json_output)


def _write_page(
    scene: Path,
    report: Report,
    html: Path,
    files: list[str],
    quality: Quality | None,
    alone: bool,
    up: str | None,
    limit_mb: float,
) -> None:
    """Write a page to fly through the result, next to the dense scene unless ``alone``."""
    import pointsplat_ns as ps
    from pointsplat_ns.pipeline.view_provider import Origin
    from pointsplat_ns.scene.runs import name_of
    from pointsplat_ns.tools.wording import quality_text

    assert report.dense is not None
    sampled = report.origin is not None and report.origin.kind is Origin.SAMPLED
    ps.write_page(
        [report.scene] if alone else [report.dense, report.scene],
        html,
        None if alone else [f"dense ({files[0]})", f"compact ({files[1]})"],
        title=name_of(scene),
        notes=[] if alone or quality is None else [quality_text(quality)],
        views=None
        if sampled
        else report.views,  # the page finds a better first view than sampled ones
        up=up,
        limit_mb=limit_mb,
        progress=True,
    )


def _print_json(
    report: Report, output: Path, quality: Quality | None, picture: Path | None, html: Path | None
) -> None:
    from pointsplat_ns.tools.wording import quality_json

    print_json(
        {
            **scene_result(report.count_before, report.scene, report.seconds, output),
            "refined": report.accepted,
            "repaired": report.repair_accepted,
            **quality_json(quality),
            "picture": picture,
            "html": html,
        }
    )


def _print_result(report: Report, output: Path, quality: Quality | None) -> None:
    also = []
    if report.accepted:
        also.append("refined")
    if report.repair_accepted:
        also.append("repaired")
    if report.last.photos is not None:
        also.append("trained on photos")
    print_result(
        report.by, also, report.count_before, report.scene, report.seconds, output, quality
    )


def _file_text(path: Path) -> str:
    """Name and size of a scene's file or SOG folder; only the name of a run."""
    from pointsplat_ns.scene.formats import SOG_META
    from pointsplat_ns.scene.runs import name_of

    file = path / SOG_META if path.is_dir() else path
    if file.is_file() and file.suffix != ".yml":
        return f"{path.name}, {written_size(file)}"
    return name_of(path)


def _print_use(
    goal: GoalName | None, page: Path | None, scene: Path, quality: Quality | None
) -> None:
    """Print the use of a page; for a headset also what lowers the fill, which limits its
    speed."""
    from pointsplat_ns.scene.runs import name_of

    if page is not None:
        use = GOALS[goal].use.format(url=quote(page.name), name=escape(name_of(scene)))
        say(f"{page}: {written_size(page)}, {use}")
    if goal == "headset" and quality is not None:
        say("if close-up views are too slow, use a smaller --keep, which lowers the fill")


def _print_next(scene: Path, output: Path, quality: Quality | None) -> None:
    """Print two commands to try after the default budget: a view of the result, and another budget
    if the PSNR suggests one, else a goal."""
    share = None
    if quality is not None and quality.psnr < 27.0:
        share = "30%"
    elif quality is not None and quality.psnr > 35.0:
        share = "3%"
    other = ["--for", "web"]
    if share is not None:
        other = ["--keep", share, "-o", str(options.output_beside(scene, share[:-1]))]
    commands = (
        ["pointsplat", "view", str(scene), str(output)],
        ["pointsplat", "compact", str(scene), *other],
    )
    first, *others = map(shlex.join, commands)
    say(f"next: {first}", *(f"      {other}" for other in others))
