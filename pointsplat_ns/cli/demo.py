"""``pointsplat demo``: the whole method, end to end, on rooms that the package makes itself."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

UNSEEN = "room2"
"""The room that the refiner is not trained on."""


def demo(
    output: Path = Path("outputs/demo"),
    keep: float = 0.1,
    scene_steps: int = 900,
    refiner_steps: int = 300,
    frames: int = 60,
    width: int = 256,
    height: int = 192,
    fresh: bool = False,
) -> None:
    """Train small scenes, prune them, train the refiner, evaluate it on a room that it never saw, export; and
    make that room small with the refiner that ships.

    Runs the same commands that a person would type, and prints them. What an interrupted demo has
    finished is not done again.

    Args:
        output: folder for everything that is made.
        keep: share of the Gaussians to keep.
        scene_steps: training steps of each room.
        refiner_steps: training steps of the refiner.
        frames: photos of each room.
        width: of a photo, pixels.
        height: of a photo, pixels.
        fresh: start over.
    """
    from pointsplat_ns.cli.report import read_evaluation, show_report
    from pointsplat_ns.cli.rooms import rooms
    from pointsplat_ns.cli.running import finished, run

    start = time.perf_counter()
    if fresh and output.exists():
        shutil.rmtree(output)
    names = ["room0", "room1", UNSEEN]
    missing = [name for name in names if not (output / "rooms" / name).is_dir()]
    if missing:
        rooms(output / "rooms", tuple(int(name[4:]) for name in missing), frames, width, height)

    scenes = output / "scenes"
    for name in names:
        if not finished(scenes / name / "splatfacto-cpu" / "demo", scene_steps):
            run(
                "ns-train splatfacto-cpu --vis tensorboard --timestamp demo "
                f"--output-dir {scenes} --experiment-name {name} --max-num-iterations {scene_steps} "
                f"--data {output / 'rooms' / name} replica-data --num-seed-points 20000"
            )
    trained = output / "refiner" / "rooms" / "pointsplat" / "demo"
    if not finished(trained, refiner_steps):
        run(
            "ns-train pointsplat --vis tensorboard --timestamp demo "
            f"--output-dir {output / 'refiner'} --experiment-name rooms --max-num-iterations {refiner_steps} "
            f"--data {scenes} --pipeline.datamanager.eval-scenes {UNSEEN} "
            f"--pipeline.model.keep {keep} --pipeline.model.size tiny"
        )
    evaluation, pictures = output / "evaluation.json", output / "pictures"
    run(f"ns-eval --load-config {trained / 'config.yml'} --output-path {evaluation} --render-output-path {pictures}")
    splat = output / f"{UNSEEN}_refined.ply"
    run(f"pointsplat export {trained} -o {splat} --force")
    dense, small = scenes / UNSEEN / "splatfacto-cpu" / "demo", output / f"{UNSEEN}_compact.ply"
    views = output / "compact.png"
    run(f"pointsplat compact {dense} --keep {keep} -o {small} --picture {views} --force")

    results = read_evaluation(evaluation)
    picture = output / "before_after.png"
    before_after(sorted(pictures.glob(f"{UNSEEN}_*.png")), results["scenes"][UNSEEN], picture)
    show_report(results)
    print(f"{splat}: open it in any 3DGS viewer, or run ns-viewer --load-config {trained / 'config.yml'}")
    print(f"{small}: the same room by pointsplat compact and the refiner that ships; {views} shows it")
    print(f"{picture}: photo, dense, pruned and refined side by side, of a room that the refiner never saw")
    print(f"done in {(time.perf_counter() - start) / 60:.1f} minutes")


def before_after(views: list[Path], scene: dict, path: Path, rows: int = 3) -> None:
    """A captioned picture of some views, each photo, dense, pruned and refined side by side.

    Args:
        views: pictures of ``ns-eval``, four images wide.
        scene: that scene's part of the evaluation.
        path: the PNG to write.
        rows: how many views to show, spread over all.
    """
    from matplotlib.image import imread
    from numpy import array_split

    from pointsplat_ns.compression.pictures import side_by_side

    titles = ["photo, held out"]
    for variant in ("dense", "pruned", "refined"):
        values = scene[variant]
        size = f"{values['gaussians']:,} Gaussians, {values['megabytes']:.1f} MB"
        titles.append(f"{variant}: {size}, {values['psnr']:.1f} dB")
    shown = views[:: max(1, len(views) // rows)][:rows]
    side_by_side([array_split(imread(view), 4, axis=1) for view in shown], titles, path)
