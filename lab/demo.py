"""Makes the scene that ships small, then runs each command of the nerfstudio method once, in three
minutes:

python -m lab.demo
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import pointsplat_ns as ps
from lab.common.printing import start as run_program
from lab.common.running import run as run_command
from pointsplat_ns.errors import need
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import flip_camera_axes, invert_rigid
from pointsplat_ns.metrics.lpips import WEIGHTS_VARIABLE
from pointsplat_ns.scene.image_files import write_picture
from pointsplat_ns.scene.runs import METHOD_NAMES
from pointsplat_ns.system.files import need_folder
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.system.terminal import print_table
from pointsplat_ns.view_sampling.poses import look_at, views_of


class DemoSettings(NamedTuple):
    """Choices of the demo, which has no options for them: as little as shows something."""

    keep: str = "10%"  # budget of the scene that ships
    photos: int = 30
    size: tuple[int, int] = (192, 144)  # width and height of a photo, pixels
    walk: float = (
        1.3  # radius of the circle of photos, metres; the room reaches 2.4 m from its middle
    )
    every: int = 5  # each so many-th Gaussian of the scene is a point that the training starts from
    scene_steps: int = 300
    refiner_steps: int = 40
    name: str = (
        "demo"  # of the folders that a second call replaces: those of the capture and the runs
    )


DEMO = DemoSettings()


def demo(output: Path = Path("outputs/demo")) -> None:
    """Make the scene that ships small, with a page and pictures. Then run each command of the
    nerfstudio method once: train a scene on a few small photos, train a refiner on it, evaluate,
    export.

    The commands that it runs are printed. A second call starts anew.

    Args:
        output: folder for all results.
    """
    start = time.perf_counter()
    need_folder(output)
    rows = compact_example(output)
    need("nerfstudio", "the rest of the demo, which trains,")
    rows += train_and_judge(output)
    show_results(rows)
    print(
        "pruned -> refined is one pass of the network that ships, tuned on this scene. For one of "
        "your own scenes: docs/guides/own_refiner.md."
    )
    print(f"done in {(time.perf_counter() - start) / 60:.1f} minutes; everything is in {output}")


def compact_example(output: Path) -> list[Row]:
    """Compact the shipped scene in a folder, with a page and pictures. Gives the rows of the
    table."""

    dense = output / "example.ply"
    small = output / "example_compact.ply"
    page = output / "example.html"
    pictures = output / "example.png"
    result = output / "compact.json"
    ps.save(ps.example_room(), dense, overwrite=True)
    run(
        f"Make the room that ships small: {DEMO.keep} of its Gaussians, merged and repaired.",
        [
            "pointsplat",
            "compact",
            dense,
            "--keep",
            DEMO.keep,
            "-o",
            small,
            "--picture",
            pictures,
            "--html",
            page,
        ]
        + ["--json", "--force"],
        result,
    )
    print(f"{page}: the room before and after, to fly through in a browser")
    print(f"{pictures}: the same as pictures, side by side")
    print(f"{small}: the smaller room; open it in any 3DGS viewer")
    made = json.loads(result.read_text("utf-8"))
    reference = "renders of the dense room"
    before = Row(
        "room that ships", "dense", made["gaussians_before"], dense.stat().st_size, None, ""
    )
    return [before, Row("", "compact", made["gaussians"], made["bytes"], made["psnr"], reference)]


def train_and_judge(output: Path) -> list[Row]:
    """Train a scene on photos of the shipped one, and a refiner on that scene; evaluate and export.
    Gives the rows of the table."""

    capture = output / "capture" / DEMO.name
    scenes = output / "scenes"
    logs = output / "logs"
    trained = scenes / "room" / METHOD_NAMES.scene / DEMO.name
    refined = output / "refiner" / "room" / METHOD_NAMES.refiner / DEMO.name
    evaluation = output / "evaluation.json"
    exported = output / "exported"
    for earlier in (capture, trained, refined):
        shutil.rmtree(earlier, ignore_errors=True)
    logs.mkdir(exist_ok=True)

    start = time.perf_counter()
    print(
        f"\nDraw {DEMO.photos} photos of the room, with their poses and points, as "
        "ns-process-data leaves them."
    )
    write_capture(ps.example_room(), capture)
    print(f"{time.perf_counter() - start:.0f} s")

    common = ["--vis", "tensorboard", "--timestamp", DEMO.name, "--experiment-name", "room"]
    run(
        f"Train a scene on these photos, {DEMO.scene_steps} steps.",
        [
            "ns-train",
            METHOD_NAMES.scene,
            "--output-dir",
            scenes,
            *common,
            "--max-num-iterations",
            DEMO.scene_steps,
        ]
        + ["--data", capture, "nerfstudio-data"],
        logs / "train_scene.txt",
    )
    run(
        "Keep 30 % of its Gaussians by PointSplat's score, and tune the network that ships on "
        f"this scene, {DEMO.refiner_steps} steps.",
        ["ns-train", METHOD_NAMES.refiner, "--output-dir", refined.parents[2], *common]
        + [
            "--max-num-iterations",
            DEMO.refiner_steps,
            "--data",
            scenes,
            "--init",
            "shipped",
        ]
        + ["--pipeline.model.lpips-weight", 0],
        logs / "train_refiner.txt",
    )
    run(
        "Compare the dense, the pruned and the refined scene with photos that were held out.",
        ["ns-eval", "--load-config", refined / "config.yml", "--output-path", evaluation]
        + ["--render-output-path", output / "pictures"],
        logs / "evaluate.txt",
    )
    run(
        "Export the refined scene.",
        [
            "ns-export",
            "gaussian-splat",
            "--load-config",
            refined / "config.yml",
            "--output-dir",
            exported,
        ],
        logs / "export.txt",
    )
    print(f"{output / 'pictures'}: photo, dense, pruned and refined side by side")
    print(f"{exported}: the refined scene")
    scene = json.loads(evaluation.read_text("utf-8"))["results"]["scenes"]["room"]
    return [
        Row(
            "trained scene" * (variant == "dense"),
            variant,
            values["gaussians"],
            1e6 * values["megabytes"],
            values["psnr"],
            "held-out photos",
        )
        for variant in ("dense", "pruned", "refined")
        for values in [scene[variant]]
    ]


def write_capture(scene: ps.Gaussians, folder: Path) -> None:
    """Write renders of the shipped scene, on a walk around its middle, as a capture: photos,
    transforms.json, and points to start from, which are the places and colours of some
    Gaussians."""
    (folder / "images").mkdir(parents=True)
    turn = torch.arange(DEMO.photos, **FLOATS) * 2 * math.pi / DEMO.photos
    yaw = turn + turn.new_tensor([0.6, 0.0, -0.6]).repeat(
        DEMO.photos // 3
    )  # rad: across the middle, and to both sides
    eyes = torch.stack(
        [DEMO.walk * turn.cos(), DEMO.walk * turn.sin(), 1.5 + 0.2 * (3 * turn).sin()], dim=1
    )
    ahead = torch.stack([-yaw.cos(), -yaw.sin(), torch.full_like(yaw, -0.2)], dim=1)
    views = views_of(look_at(eyes, eyes + ahead), *DEMO.size, diagonal=5.0)
    poses = flip_camera_axes(invert_rigid(views.viewmats)).tolist()
    frames = []
    for number, view in enumerate(tracked(views, "drawing photos", len(views))):
        name = f"images/{number:02d}.png"
        write_picture(ps.render(scene, view), folder / name)
        frames.append({"file_path": name, "transform_matrix": poses[number]})
    (width, height) = DEMO.size
    K = views.Ks[0].tolist()
    camera = {
        "fl_x": K[0][0],
        "fl_y": K[1][1],
        "cx": K[0][2],
        "cy": K[1][2],
        "w": width,
        "h": height,
    }

    some = scene[:: DEMO.every]
    colors = (255 * (0.5 + SH_C0 * some.features_dc).clamp(0, 1)).round()
    kinds = [f"property float {axis}" for axis in "xyz"]
    kinds += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = "\n".join(
        ["ply", "format ascii 1.0", f"element vertex {len(some)}", *kinds, "end_header"]
    )
    points = torch.cat([some.means, colors], dim=1).numpy()
    np.savetxt(
        folder / "points.ply", points, fmt=["%.5g"] * 3 + ["%d"] * 3, header=header, comments=""
    )
    content = {"camera_model": "OPENCV", **camera, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def run(about: str, words: list[Any], log: Path) -> None:
    """Say what a command does, run it, and print the seconds that it took. Its standard output goes
    to a file. Raises PointSplatError if the command fails."""

    start = time.perf_counter()
    print(f"\n{about}", end="")
    # Nothing is there: LPIPS is left out, whose weights are a download of 233 MB.
    no_lpips = {WEIGHTS_VARIABLE: str(log.with_name("no_lpips_weights"))}
    run_command(shlex.join(map(str, words)), log, show_errors=True, **no_lpips)
    print(f"{time.perf_counter() - start:.0f} s")


class Row(NamedTuple):
    """A line of the table."""

    scene: str
    variant: str
    gaussians: int
    bytes: float  # of a PLY of float32
    psnr: float | None  # dB
    reference: str  # of the PSNR


def show_results(rows: list[Row]) -> None:
    """Print the table of all scenes that the demo made."""

    lines = [
        (
            row.scene,
            row.variant,
            f"{row.gaussians:,}",
            f"{row.bytes / 1e6:.2f}",
            "" if row.psnr is None else f"{row.psnr:.1f}",
            row.reference,
        )
        for row in rows
    ]
    print()
    print_table(
        ("scene", "variant", "Gaussians", "MB", "PSNR dB", "against"), lines, left=(0, 1, 5)
    )


if __name__ == "__main__":
    run_program(demo)
