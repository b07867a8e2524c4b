"""``pointsplat render``: film one scene, or two side by side."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json
from pointsplat_ns.system.quantities import seconds_text
from pointsplat_ns.system.terminal import say


def render(
    scene: options.Scene,
    other: tyro.conf.Positional[Path | None] = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    poses: options.Poses = None,
    up: options.Up = None,
    data: options.Data = None,
    width: int | None = None,
    height: int | None = None,
    fps: float = 24.0,
    seconds: float | None = None,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Film a scene, or two scenes side by side from the same cameras, with or without a GPU.

    The camera path passes exactly through the poses. Without poses, it circles an object, or walks
    past the views that show most of a room.

    Args:
        other: a second scene in the same frame, to compare with.
        output: .mp4 for a video; a folder for PNG frames, one per pose of --poses unless --seconds
            is given; or .png for only the first frame. By default a video beside the scene:
            room.mp4 for room.ply, render.mp4 in the folder of a run. The output appears only when
            complete.
        width: width of one scene's picture, pixels; by default that of the photos, at most 960.
        height: height of one scene's picture, pixels; by default in the aspect ratio of the photos.
        fps: frames per second.
        seconds: length of the film; by default 10, or enough for every pose of the dataset.
    """
    options.need_scenes(scene, other)
    import pointsplat_ns as ps
    from pointsplat_ns.system.files import bytes_text
    from pointsplat_ns.system.outputs import unnamed

    start = time.perf_counter()
    options.check_poses(poses)
    beside = options.output_beside(scene, "render", ".mp4")
    output = output or unnamed(
        beside if beside.name == "render.mp4" else beside.with_name(f"{scene.stem}.mp4")
    )
    count = ps.render_path(
        scene,
        output,
        other,
        views=poses,
        up=up,
        data=data,
        width=width,
        height=height,
        fps=fps,
        seconds=seconds,
        force=force,
        progress=True,
    )
    files = output.iterdir() if output.is_dir() else [output]
    size = sum(file.stat().st_size for file in files)
    seconds_taken = time.perf_counter() - start
    if json_output:
        print_json({"output": output, "frames": count, "bytes": size, "seconds": seconds_taken})
        return
    frames = "1 frame" if count == 1 else f"{count} frames"
    say(f"{output}: {frames}, {bytes_text(size)}, in {seconds_text(seconds_taken)}")
