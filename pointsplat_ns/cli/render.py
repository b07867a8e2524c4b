"""``pointsplat render``: a film of one scene, or of two."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json
from pointsplat_ns.system.quantities import seconds_text


def render(
    scene: options.Scene,
    other: tyro.conf.Positional[Path | None] = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    path: Path | None = None,
    poses: options.Poses = None,
    split: Literal["side-by-side", "wipe"] = "side-by-side",
    up: options.Up = None,
    data: options.Data = None,
    width: int | None = None,
    height: int | None = None,
    fps: float | None = None,
    seconds: float | None = None,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Film a scene along a camera path, or two scenes from the same cameras, on any machine.

    Args:
        other: a second scene in the same frame, to compare with.
        output: .mp4 for a video; a folder for PNG frames, one for each pose of --poses unless --seconds is given; or
            .png for the first frame alone. By default a video beside the scene: room.mp4 for room.ply, render.mp4 in
            the folder of a run. It appears when it is complete.
        path: a camera path that nerfstudio's viewer saved (.json). By default the film goes exactly through the poses;
            without poses around an object, or past what shows most of a room.
        split: layout of two scenes.
        width: width of one scene's picture, pixels; by default that of the saved path, or of the photos, at most 960.
        height: its height, pixels; by default in the proportion of the path or the photos.
        fps: frames a second; by default 24, or as in the saved path.
        seconds: length; by default 10, or long enough for every pose of the dataset or the saved path.
    """
    options.need_scenes(scene, other)
    import pointsplat_ns as ps
    from pointsplat_ns.io.files import bytes_text, need_folder, need_writable
    from pointsplat_ns.pages.video import kind_of

    start = time.perf_counter()
    options.check_poses(poses)
    output = output or _beside(scene)
    if kind_of(output) == "frames":
        need_folder(output)
    else:
        need_writable(output, force)
    count = ps.render_path(
        scene, output, other, path=path, views=poses, split=split, up=up, data=data, width=width, height=height,
        fps=fps, seconds=seconds, force=force, progress=True,
    )  # fmt: skip
    files = output.iterdir() if output.is_dir() else [output]
    size, seconds_taken = sum(file.stat().st_size for file in files), time.perf_counter() - start
    if json_output:
        print_json({"output": output, "frames": count, "bytes": size, "seconds": seconds_taken})
        return
    frames = "1 frame" if count == 1 else f"{count} frames"
    print(f"{output}: {frames}, {bytes_text(size)}, in {seconds_text(seconds_taken)}")


def _beside(scene: Path) -> Path:
    """The default video: beside a file, in the folder of a run."""
    from pointsplat_ns.cli.scene_options import output_beside

    beside = output_beside(scene, "render", ".mp4")
    return beside if beside.name == "render.mp4" else beside.with_name(f"{scene.stem}.mp4")
