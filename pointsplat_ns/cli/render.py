"""``pointsplat render``: a film of one scene, or of two."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pointsplat_ns.cli.printing import Json, print_json
from pointsplat_ns.cli.scene_options import Data, Poses, Scene, check_poses, claim_file, claim_folder
from pointsplat_ns.system.quantities import seconds_text


def render(
    scene: Scene,
    other: tyro.conf.Positional[Path | None] = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    path: Path | None = None,
    poses: Poses = None,
    split: Literal["side-by-side", "wipe"] = "side-by-side",
    labels: tuple[str, ...] | None = None,
    up: str | None = None,
    data: Data = None,
    width: int | None = None,
    height: int | None = None,
    fps: float | None = None,
    seconds: float | None = None,
    force: bool = False,
    json_output: Json = False,
) -> None:
    """Film a scene along a camera path, or two scenes from the same cameras, on any machine.

    Args:
        scene: a file of any format, a checkpoint, or a run (its folder or config.yml).
        other: a second scene in the same frame, to compare with.
        output: .mp4 for a video, a folder for PNG frames, .png for the first frame alone; by default a video beside the
            scene: room.mp4 for room.ply, render.mp4 in the folder of a run. It appears when it is complete.
        path: a camera path that nerfstudio's viewer saved (.json). By default the film goes exactly through the poses;
            without poses around an object, or past what shows most of a room.
        poses: a file of cameras: cameras.json of 3DGS, transforms.json of nerfstudio, or the folder of a COLMAP
            project. By default one that lies beside the scene or above it, or the poses of a run's dataset; none
            samples views instead. A folder gets one frame for each pose of a file, unless --seconds is given.
        split: layout of two scenes.
        labels: labels of two scenes; by default their names and counts. "" writes none on one.
        up: the axis that is up in the scene, for a film without poses: x, y, z, -x, -y or -z; by default the file's
            own, or an estimate. Write --up=-y for a negative axis.
        data: folder of the run's photos and poses, or one above it, if it is no longer where the run says.
        width: width of one scene's picture, pixels; by default that of the saved path, or of the photos, at most 960.
        height: its height, pixels; by default in the proportion of the path or the photos.
        fps: frames a second; by default 24, or as in the saved path.
        seconds: length; by default 10, or long enough for every pose of the dataset or the saved path.
        force: overwrite existing files.
        json_output: print the result as JSON, and nothing else on standard output.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.io.files import bytes_text
    from pointsplat_ns.pages.video import kind_of

    start = time.perf_counter()
    check_poses(poses)
    output = output or _beside(scene)
    if kind_of(output) == "frames":
        claim_folder(output)
    else:
        claim_file(output, force)
    count = ps.render_path(
        scene, output, other, path=path, views=poses, split=split, labels=labels, up=up, data=data, width=width,
        height=height, fps=fps, seconds=seconds, force=force, progress=True,
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

    beside = output_beside(scene, "render")
    return beside.with_name(f"{scene.stem}.mp4" if beside.stem.endswith("_render") else "render.mp4")
