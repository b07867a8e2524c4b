"""``pointsplat clean``: remove Gaussians that no picture needs."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, print_result, scene_result
from pointsplat_ns.pipeline.options import SpzVersion, ViewOptions
from pointsplat_ns.system.terminal import say


def clean(
    scene: options.Scene,
    views: options.Flat[ViewOptions],
    output: options.Output = None,
    strength: float = 0.5,
    picture: Path | None = None,
    spz_version: SpzVersion = 4,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Remove floaters, and Gaussians that cannot be drawn or are never visible.

    Args:
        output: file to write, in any format of convert; by default beside the scene, in its
            format: room_clean.ply for room.ply.
        strength: strength of the removal of floaters, in [0, 1]. Floaters are Gaussians far in
            front of the visible surfaces that hardly change pictures. 0 removes only Gaussians that
            cannot be drawn or seen.
        picture: .png file with three views of the scene, the removed Gaussians with a colour per
            cluster, and the result; by default none.
        spz_version: version of an .spz, as for convert.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.pipeline import run
    from pointsplat_ns.pipeline.quality import judge_of, quality_of_file
    from pointsplat_ns.tools.comparison_plots import plot_cleaning
    from pointsplat_ns.tools.wording import cleaning_lines, log_lines, quality_json

    options.need_one_scene(scene)
    options.check_poses(views.poses)
    output = output or options.output_beside(scene, "clean")
    options.check_outputs(output, force, picture)
    done = run.clean(scene, strength, views, progress=True)
    if picture is not None:
        plot_cleaning(done, picture)
    log_lines(cleaning_lines(done.cleaning))
    ps.save(done.scene, output, progress=True, overwrite=True, spz_version=spz_version)
    quality = quality_of_file(judge_of(done.dense, done.views), done.scene, output)
    before = len(done.dense)
    if json_output:
        result = scene_result(before, done.scene, done.seconds, output)
        print_json({**result, **quality_json(quality), "picture": picture})
        return
    print_result("clean", [], before, done.scene, done.seconds, output, quality)
    if picture is not None:
        say(f"{picture}: the scene, the removed Gaussians and the result, side by side")
