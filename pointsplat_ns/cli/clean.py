"""``pointsplat clean``: a scene without what no picture needs."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, print_result, scene_result
from pointsplat_ns.system.terminal import say


def clean(
    scene: options.Scene,
    output: options.Output = None,
    strength: float = 0.5,
    picture: Path | None = None,
    poses: options.Poses = None,
    resolution: options.Resolution = None,
    up: options.Up = None,
    data: options.Data = None,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Remove floaters, and what cannot be drawn or is seen from nowhere.

    Args:
        output: file to write: .ply, .spz, .sog, .splat; by default in the format of the scene and
            beside it: room_clean.ply for room.ply.
        strength: in [0, 1]; more removes more floaters: Gaussians far before what views show,
            without which pictures hardly change. 0 removes only what cannot be drawn or seen.
        picture: a .png file that shows, in three views, the scene, what goes in a colour for each
            cluster, and the result; by default none.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.pipeline.quality import judge_of, quality_of_file
    from pointsplat_ns.pipeline.requests import Looking, clean_source

    options.need_one_scene(scene)
    options.check_poses(poses)
    output = output or options.output_beside(scene, "clean")
    options.check_outputs(output, force, picture)
    looking = Looking(poses, resolution, up, data)
    dense, cleaned, seconds, source = clean_source(scene, strength, looking, picture, True)
    ps.save(cleaned, output, progress=True, overwrite=True)
    quality = quality_of_file(judge_of(dense, source), cleaned, output)
    if json_output:
        compared = quality.as_dict() if quality else {"psnr": None}
        print_json(
            {**scene_result(len(dense), cleaned, seconds, output), **compared, "picture": picture}
        )
        return
    print_result("clean", [], len(dense), cleaned, seconds, output, quality)
    if picture is not None:
        say(f"{picture}: the scene, what goes, and the result, side by side")
