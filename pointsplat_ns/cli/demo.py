"""``pointsplat demo``: compacts the shipped scene, then trains scenes and a refiner on synthetic rooms."""

from __future__ import annotations

import shlex
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.cli.printing import written_size
from pointsplat_ns.cli.scene_options import Share, claim_folder, claim_outputs


@dataclass(frozen=True)
class DemoSettings:
    """Choices of the demo that have no option."""

    rooms: tuple[str, ...] = ("room0", "room1", "room2")
    """Names of the synthetic rooms, each with its seed."""
    held_out: str = "room2"
    """The room without a part in the refiner's training."""
    timestamp: str = "demo"
    """Folder name of the runs, constant so that finished runs are found again."""
    advice: str = "start over with --force, or name another --output"
    """Advice if a training with another number of steps is finished."""


DEMO = DemoSettings()


def demo(
    output: Path = Path("outputs/demo"),
    keep: Share = 0.1,
    scene_steps: int = 900,
    refiner_steps: int = 300,
    frames: int = 60,
    width: int = 256,
    height: int = 192,
    scene_only: bool = False,
    force: bool = False,
) -> None:
    """Compact the scene that ships and draw it before and after, which takes a minute. Then continue with training,
    which may be stopped: train small scenes, prune them, train the refiner, evaluate it on an unseen room, and export.

    The commands that it runs are printed. After an interruption, a second call continues with what is not finished. It
    never removes a training that has finished, except with --force.

    Args:
        output: folder for all results.
        keep: share of the Gaussians to keep.
        scene_steps: training steps of each room.
        refiner_steps: training steps of the refiner.
        frames: photos of each room.
        width: of a photo, pixels.
        height: of a photo, pixels.
        scene_only: write the scene that ships as room.ply, in this folder, and end.
        force: start over: first remove rooms, trainings and pictures of an earlier demo in the folder.
    """
    from pointsplat_ns.errors import need
    from pointsplat_ns.nerfstudio_plugin.running import has_finished

    if scene_only:
        write_example(Path("room.ply"), force)
        return
    claim_folder(output)
    for folder in ("rooms", "scenes", "refiner", "pictures") if force else ():
        if (output / folder).exists():
            shutil.rmtree(output / folder)
    scenes, refiner = training_folders(output)
    for training, steps in [*((scene, scene_steps) for scene in scenes.values()), (refiner, refiner_steps)]:
        has_finished(training, steps, DEMO.advice)  # refuses another number of steps before the work
    compact_example(output, keep)
    need("nerfstudio", "the rest of the demo, which trains,")
    print(
        "\nThat is a usable result. The demo now goes on to train scenes and a refiner of its own, for about "
        "15 minutes on two cores.\nIt may be stopped at any time with Ctrl-C; started again, it does "
        "not repeat what it has finished.",
        flush=True,
    )
    train_and_judge(output, keep, scene_steps, refiner_steps, (frames, width, height))


def training_folders(output: Path) -> tuple[dict[str, Path], Path]:
    """Folders of the trained scenes by room, and the folder of the trained refiner."""
    from pointsplat_ns.io.runs import METHOD_NAMES
    from pointsplat_ns.nerfstudio_plugin.running import folder_of_run

    scenes = {name: folder_of_run(output / "scenes", name, METHOD_NAMES.scene, DEMO.timestamp) for name in DEMO.rooms}
    return scenes, folder_of_run(output / "refiner", "rooms", METHOD_NAMES.refiner, DEMO.timestamp)


def write_example(path: Path, force: bool) -> None:
    """Write the shipped scene."""
    import pointsplat_ns as ps

    claim_outputs(path, force)
    scene = ps.example_room()
    ps.save(scene, path)
    print(f"{path}: {len(scene):,} Gaussians, {written_size(path)}")


def compact_example(output: Path, keep: float) -> None:
    """Compact the shipped scene to a share of its Gaussians, and draw it before and after, in a folder."""
    import pointsplat_ns as ps
    from pointsplat_ns.nerfstudio_plugin.running import run

    start = time.perf_counter()
    dense, small, picture = (output / f"example{end}" for end in (".ply", "_compact.ply", ".png"))
    ps.save(ps.example_room(), dense)
    words = ["pointsplat", "compact", str(dense), "--keep", f"{keep:g}", "-o", str(small), "--picture", str(picture)]
    run(shlex.join([*words, "--force"]))
    print(f"\n{picture}: the scene before and after, side by side")
    print(f"{small}: the smaller scene; open it in any 3DGS viewer")
    print(f"made in {time.perf_counter() - start:.0f} seconds")


def train_and_judge(
    output: Path, keep: float, scene_steps: int, refiner_steps: int, photos: tuple[int, int, int]
) -> None:
    """Train a scene of each of three rooms and a refiner on two of them; evaluate it on the third, and export the
    third. ``photos`` are the number of photos of each room, their width and height in pixels."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.report import read_evaluation, show_report
    from pointsplat_ns.nerfstudio_plugin.running import (
        evaluate_command,
        has_finished,
        remove_interrupted,
        run,
        train_refiner_command,
        train_scene_command,
    )
    from pointsplat_ns.rooms import write_room

    start = time.perf_counter()
    rooms, scenes, refiners = output / "rooms", output / "scenes", output / "refiner"
    scene_runs, trained = training_folders(output)
    for name in DEMO.rooms:
        if not (rooms / name).is_dir():
            print(write_room(rooms / name, int(name[4:]), *photos))
    for name, scene_run in scene_runs.items():
        if not has_finished(scene_run, scene_steps, DEMO.advice):
            remove_interrupted(scene_run)
            run(train_scene_command(rooms / name, scenes, name, scene_steps, DEMO.timestamp, seed_points=20_000))
    if not has_finished(trained, refiner_steps, DEMO.advice):
        remove_interrupted(trained)
        options = {"pipeline.model.keep": keep, "pipeline.model.size": "tiny"}
        run(train_refiner_command(scenes, refiners, "rooms", refiner_steps, DEMO.timestamp, (DEMO.held_out,), options))
    evaluation, pictures = output / "evaluation.json", output / "pictures"
    run(evaluate_command(trained, evaluation, pictures))
    refined, small = output / f"{DEMO.held_out}_refined.ply", output / f"{DEMO.held_out}_compact.ply"
    run(shlex.join(["pointsplat", "export", str(trained), "-o", str(refined), "--force"]))
    dense, views = scene_runs[DEMO.held_out], output / "compact.png"
    words = ["pointsplat", "compact", str(dense), "--keep", f"{keep:g}", "-o", str(small), "--picture", str(views)]
    run(shlex.join([*words, "--force"]))

    results = read_evaluation(evaluation)
    picture = output / "before_after.png"
    before_after(sorted(pictures.glob(f"{DEMO.held_out}_*.png")), results["scenes"][DEMO.held_out], picture)
    show_report(results)
    config = shlex.quote(str(trained / "config.yml"))
    print(f"{refined}: open it in any 3DGS viewer, or run ns-viewer --load-config {config}")
    print(f"{small}: the same room by pointsplat compact; {views} shows it")
    print(f"{picture}: photo, dense, pruned and refined side by side, of a room that the refiner never saw")
    print(f"done in {(time.perf_counter() - start) / 60:.1f} minutes")


def before_after(views: list[Path], scene: dict, path: Path, rows: int = 3) -> None:
    """Draw some views, spread over all, with captions from the evaluation of a scene: photo, dense, pruned and refined
    side by side, as in the images that ``ns-eval`` wrote."""
    from matplotlib.image import imread
    from numpy import array_split
    from numpy.typing import ArrayLike

    from pointsplat_ns.compression.pictures import side_by_side

    titles = ["photo, held out"]
    for variant in ("dense", "pruned", "refined"):
        values = scene[variant]
        size = f"{values['gaussians']:,} Gaussians, {values['megabytes']:.1f} MB"
        titles.append(f"{variant}: {size}, {values['psnr']:.1f} dB")
    chosen = views[:: max(1, len(views) // rows)][:rows]
    images: list[list[ArrayLike]] = [[*array_split(imread(view), len(titles), axis=1)] for view in chosen]
    side_by_side(images, titles, path)
