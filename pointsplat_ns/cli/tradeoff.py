"""``pointsplat tradeoff``: measure quality against speed and size of a scene."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, psnr_text
from pointsplat_ns.pipeline.options import ViewOptions
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.system.terminal import print_table, say

if TYPE_CHECKING:
    from pointsplat_ns.tools.tradeoff.points import Tradeoff

Repair = Literal["none", "quick", "thorough", "photos"]

_NAMES = f"{{{','.join(get_args(Repair))}}}"


def tradeoff(
    scene: options.Scene,
    view_options: options.Flat[ViewOptions],
    output: options.Output = None,
    keep: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[STR [STR ...]]")] = None,
    within: float = 0.5,
    by: tuple[str, ...] = ("merge",),
    repairs: Annotated[
        tuple[Repair, ...] | None, tyro.conf.arg(metavar=f"[{_NAMES} [{_NAMES} ...]]")
    ] = None,
    views: int | None = None,
    quick: bool = False,
    photos: Path | None = None,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Measure how a scene trades quality for frame time, size and count on this machine, for all
    combinations of budgets, methods and repairs. Results are a JSON file, and a page with pictures.

    Args:
        output: folder for the results; by default beside the scene: room_tradeoff for room.ply,
            tradeoff in the folder of a run.
        keep: budgets: ratios (30%), counts (50000) or sizes (12MB); by default 70% 50% 30% 20% 10%
            5%, with --quick 50% 20% 5%.
        within: maximum loss of the recommended point against photos, dB. Without photos, the loss
            is estimated from renders.
        by: pruning methods, as for prune.
        repairs: repairs to try: none, compact's efforts quick and thorough, or its --photos; by
            default none quick, with --quick none.
        views: maximum number of views; by default 12, with --quick 4; without photos at most 12.
        quick: a first look: fewer budgets and views, no repairs, and frames of half the width.
        photos: folder of photos to judge by, for a scene without a run: every eighth photo, by
            name. Poses come from --poses, or from a camera file nearby.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.tools.tradeoff.points import RESULTS
    from pointsplat_ns.tools.tradeoff.recommend import next_best
    from pointsplat_ns.tools.wording import quality_line

    options.check_poses(view_options.poses)
    folder = output or options.output_beside(scene, "tradeoff", "")
    found = ps.measure_tradeoff(
        scene,
        folder,
        keep=keep,
        within=within,
        by=by,
        repairs=repairs,
        views=views,
        quick=quick,
        poses=view_options.poses,
        resolution=view_options.resolution,
        up=view_options.up,
        data=view_options.data,
        photos=photos,
        force=force,
        progress=True,
    )
    if json_output:
        print_json({"output": folder, **json.loads((folder / RESULTS["json"]).read_text("utf-8"))})
        return
    _print_table(found)
    for note in found.notes:
        say(f"note: {note}")
    say(found.why)
    best = found.point(found.recommended)
    if best is found.points[0]:  # the dense scene needs no command
        best = next_best(found.points) or best
    if best is not found.points[0]:
        say(f"{best.label}: {quality_line(best.against_dense.psnr, best.against_dense.ssim)}")
    if best.command:
        say(f"$ {best.command}")
    say(f"open {folder / RESULTS['page']}")


def _print_table(found: Tradeoff) -> None:
    """Print the most important figures; the JSON file has all."""
    from pointsplat_ns.system.files import three_digits

    photos = found.points[0].against_photos is not None
    count = counted(len(found.points), "point")
    say(f"{found.scene}: {count}, judged in {found.judged_in}, {found.views_origin}")
    say(found.machine)
    rows = []
    for point in found.points:
        psnr_in_photos = point.against_photos.psnr if point.against_photos else None
        rows.append(
            (
                point.label + (" *" if point.key == found.recommended else ""),
                f"{point.gaussians:,}",
                three_digits(point.bytes / 1e6),
                "{:.1f} ({:.1f}-{:.1f})".format(*point.speed),
                three_digits(point.frame_ms),
                f"{point.fill:.1f}",
                *([psnr_text(psnr_in_photos)] if photos else []),
                psnr_text(point.against_dense.psnr),
                f"{point.against_dense.ssim:.2f}",
            )
        )
    columns = ["", "Gaussians", "MB", "times as fast", "ms per\nframe", "fill"]
    print_table(
        (*columns, *(["dB,\nphotos"] if photos else []), "dB,\ndense", "SSIM"),
        rows,
        "*: recommended; times as fast as the dense scene: median and quartiles over views; fill: "
        "Gaussians drawn per pixel; dB of PSNR, and SSIM, against the dense scene",
    )
