"""Trains the same photos with ``splatfacto-cpu`` and with OpenSplat's CPU backend: held-out PSNR over time.

    python -m lab.training.opensplat replica/kitchen replica/office0 --opensplat opensplat --plot curves.png

OpenSplat (https://github.com/pierotofy/OpenSplat, AGPL) is a program of its own, built by whoever runs this. Both get
the same folder in nerfstudio's layout: photos already made smaller, poses, and the seed points that ``replica-data``
fuses from depth images; OpenSplat gets the frames that are not held out. It trains twice, with its schedules as they
are and in proportion to the length of the run, as ours are. The Gaussians of each are drawn by our rasterizer.
OpenSplat takes the middle of a photo to be its principal point: photos are cut so that it is.

Its CPU backend at commit 15b7e80 sorts Gaussians by memory that is not their depth (``camDepths`` in ``gsplat_cpu.cpp``
is a strided view that is read as if it were whole), so that its scenes look right in nothing but itself. Build it with
``.contiguous()`` there.

Time is that of all threads together, in minutes of the processor: with one thread, what a clock shows on an idle core.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from json import dumps, loads
from pathlib import Path

import numpy as np
import psutil
import torch
import tyro
from PIL import Image
from plyfile import PlyData, PlyElement

import pointsplat_ns as ps
from lab.common.compare import mean_psnr
from lab.common.printing import console, save_figure, start, table
from lab.common.results import write_json
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_photos
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import fitted_schedules, splatfacto_cpu_config
from pointsplat_ns.views import Views

OURS, DEFAULTS, SCALED = "splatfacto-cpu", "OpenSplat, its own schedules", "OpenSplat, schedules in proportion"
SCHEDULES = ("resolution_schedule", "sh_degree_interval", "warmup_length", "stop_screen_size_at", "refine_every")
"""Options of both programs, of the same defaults, that depend on the length of a training."""


@dataclass
class Look:
    """What a training had come to at one moment."""

    scene: str
    method: str
    step: int
    minutes: float
    """Of the processor, since the program was started."""
    clock: float
    """Minutes by the clock."""
    gaussians: int
    psnr: float
    """Mean over all held-out photos, dB."""


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    opensplat: Path,
    steps: int = 2000,
    ours: int | None = None,
    downscale: int = 2,
    looks: int = 8,
    threads: int = 1,
    output: Path = Path("outputs/opensplat"),
    plot: Path | None = None,
    json: Path | None = None,
) -> None:
    """Train each scene three times, and print what the held-out photos say of it.

    Args:
        scenes: folders in the Replica layout, with depth images.
        opensplat: the program.
        steps: that OpenSplat trains.
        ours: steps that ``splatfacto-cpu`` trains; as many by default.
        downscale: photos are made so many times smaller a side.
        looks: how often each training is looked at; the last is its end.
        threads: of each training.
        output: folder for the photos and all trainings. A finished training there is not repeated.
        plot: draw PSNR over time here, as a PNG.
        json: write all figures here.
    """
    found: list[Look] = []
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    for path in scenes:
        folder = output / path.name
        exported(path, folder / "data", downscale)
        lengths = {OURS: ours or steps, SCALED: steps, DEFAULTS: steps}
        for method, length in lengths.items():
            words = _command(method, opensplat.resolve(), folder / "data", folder / _slug(method), length, looks)
            train(words, folder / _slug(method), environment)
        views, photos = dataset_photos(_run(folder / _slug(OURS)), "test", sys.maxsize)
        for method in lengths:
            found += looked_at(path.name, method, folder / _slug(method), views, photos)
            write_json(json, {"threads": threads, "downscale": downscale, "looks": [asdict(look) for look in found]})
    print_table(found)
    if plot is not None:
        draw(found, plot)


def exported(scene: Path, folder: Path, downscale: int) -> None:
    """Write a scene in nerfstudio's layout, smaller: ``transforms.json`` of all frames, another of those that train,
    the photos and the seed points. Nothing is done if it is there."""
    if (folder / "transforms.json").is_file():
        return
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "train").mkdir(exist_ok=True)
    parser = ReplicaDataParserConfig(data=scene).setup()
    splits = {split: parser.get_dataparser_outputs(split) for split in ("train", "test")}
    camera = splits["train"].cameras[0]
    intrinsics = {name: float(getattr(camera, a)) / downscale for name, a in _INTRINSICS.items()}
    whole_size = torch.tensor([int(camera.width), int(camera.height)]) // downscale
    corner, size = centred(torch.tensor([intrinsics["cx"], intrinsics["cy"]]), whole_size)
    intrinsics["cx"], intrinsics["cy"] = intrinsics["cx"] - int(corner[0]), intrinsics["cy"] - int(corner[1])
    frames: dict[str, list[dict]] = {}
    for split, outputs in splits.items():
        for index, source in enumerate(outputs.image_filenames):
            name = f"images/{source.stem}.png"
            with Image.open(source) as photo:
                smaller = photo.reduce(downscale).crop((*corner.tolist(), *(corner + size).tolist()))
            smaller.save(folder / name)
            pose = torch.cat([outputs.cameras.camera_to_worlds[index], torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
            frames.setdefault(split, []).append({"file_path": name, "transform_matrix": pose.tolist()})
    common = {"camera_model": "OPENCV", **intrinsics, "w": int(size[0]), "h": int(size[1])}
    points, colors = (splits["train"].metadata[name] for name in ("points3D_xyz", "points3D_rgb"))
    _write_points(folder / "points.ply", points, colors)
    theirs = [{**frame, "file_path": f"../{frame['file_path']}"} for frame in frames["train"]]
    (folder / "train" / "transforms.json").write_text(
        dumps({**common, "ply_file_path": "../points.ply", "frames": theirs}), "utf-8"
    )
    names = {split: [frame["file_path"] for frame in frames[split]] for split in frames}
    lists = {"train_filenames": names["train"], "val_filenames": names["test"], "test_filenames": names["test"]}
    whole = {**common, "ply_file_path": "points.ply", "frames": frames["train"] + frames["test"], **lists}
    (folder / "transforms.json").write_text(dumps(whole), "utf-8")


def centred(principal: torch.Tensor, size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Corner (2,) and size (2,), in whole pixels, of the largest part of a photo whose middle is the principal point
    (2,), to half a pixel."""
    half = torch.minimum(principal, size - principal)
    return (principal - half).round().long(), (2 * half).round().long()


_INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}


def _write_points(path: Path, points: torch.Tensor, colors: torch.Tensor) -> None:
    """As text, in the order of properties that OpenSplat wants."""
    kinds = [(axis, "f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.array([(*point, *color) for point, color in zip(points.tolist(), colors.tolist(), strict=True)], kinds)
    PlyData([PlyElement.describe(rows, "vertex")], text=True).write(path)


def _slug(method: str) -> str:
    return method.lower().replace(",", "").replace(" ", "-")


def _command(method: str, opensplat: Path, data: Path, folder: Path, steps: int, looks: int) -> list[str]:
    """The words that train."""
    every = str(max(1, steps // looks))
    if method == OURS:
        program = [sys.executable, "-c", "from nerfstudio.scripts.train import entrypoint; entrypoint()"]
        program += ["splatfacto-cpu", "--max-num-iterations", str(steps), "--steps-per-save", every]
        program += ["--save-only-latest-checkpoint", "False"]
        program += ["--output-dir", str(folder), "--data", str(data), "nerfstudio-data", "--auto-scale-poses", "False"]
        return [*program, "--orientation-method", "none", "--center-method", "none"]
    program = [str(opensplat), str(data / "train"), "--cpu", "--keep-crs", "--num-iters", str(steps)]
    program += ["--save-every", every, "--output", str(folder / "splat.ply")]
    if method == SCALED:
        config = splatfacto_cpu_config()
        config.max_num_iterations = steps
        model = fitted_schedules(config).pipeline.model
        for name in SCHEDULES:
            program += [f"--{name.replace('_', '-')}", str(getattr(model, name))]
    return program


def train(words: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Run a training, and note when each of its files was there: ``times.json``. A training that was finished is not
    repeated.

    Raises:
        PointSplatError: if it fails.
    """
    record = folder / "times.json"
    if record.is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    times: dict[str, tuple[float, float]] = {}
    start = time.monotonic()
    with (folder / "log.txt").open("w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, env=environment)
        seen = psutil.Process(process.pid)
        while process.poll() is None:
            time.sleep(0.1)
            spent, clock = _cpu_seconds(seen), time.monotonic() - start
            for file in _saved(folder):
                times.setdefault(str(file.relative_to(folder)), (spent, clock))
    if process.returncode:
        raise PointSplatError(f"{words[0]}: it ended with status {process.returncode}; see {folder / 'log.txt'}")
    record.write_text(dumps(times), "utf-8")


def _cpu_seconds(process: psutil.Process) -> float:
    """Of a process and those that it started, as far as they are still there."""
    try:
        each = [process, *process.children(recursive=True)]
        return sum(sum(one.cpu_times()[:4]) for one in each if one.is_running())
    except psutil.NoSuchProcess:
        return 0.0


def _saved(folder: Path) -> Iterator[Path]:
    """What a training has saved so far."""
    yield from folder.glob("*.ply")
    yield from folder.rglob("step-*.ckpt")


def _run(folder: Path) -> Path:
    """The run's folder of a training of ours."""
    return next(folder.rglob("config.yml")).parent


def _step(file: str) -> int:
    digits = "".join(filter(str.isdigit, Path(file).stem))
    return int(digits) + (file.endswith(".ckpt")) if digits else sys.maxsize


def looked_at(scene: str, method: str, folder: Path, views: Views, photos: list[torch.Tensor]) -> list[Look]:
    """Judge all that a training saved, in the order of time."""
    looks = []
    times: dict[str, tuple[float, float]] = loads((folder / "times.json").read_text("utf-8"))
    for file, (spent, clock) in sorted(times.items(), key=lambda item: _step(item[0])):
        if spent:
            gaussians: Gaussians = ps.load(folder / file)
            psnr = mean_psnr(gaussians, views, photos)
            looks.append(Look(scene, method, _step(file), spent / 60, clock / 60, len(gaussians), psnr))
    return looks


def looks_of(found: list[Look], scene: str, method: str) -> list[Look]:
    """The looks at one training, in order."""
    return [look for look in found if (look.scene, look.method) == (scene, method)]


def print_table(found: list[Look]) -> None:
    """A row a training: its end, and when it was as good as OpenSplat's better end."""
    rows = []
    for scene in dict.fromkeys(look.scene for look in found):
        trainings = {method: looks_of(found, scene, method) for method in METHODS}
        best = max((trainings[method][-1] for method in (DEFAULTS, SCALED)), key=lambda look: look.psnr)
        for method, looks in trainings.items():
            end = looks[-1]
            steps = max(look.step for look in looks if look.step < sys.maxsize)
            reached = next((look.minutes for look in looks if look.psnr >= best.psnr), None)
            after = ["never", ""] if reached is None else [f"{reached:.1f}", f"{reached / best.minutes:.2f}"]
            row = [scene, method, f"{steps:,}", f"{end.gaussians:,}", f"{end.psnr:.2f}", f"{end.minutes:.1f}"]
            rows.append([*row, *after])
    heads = ("scene", "trained by", "steps", "Gaussians", "PSNR, dB", "minutes", "as good as OpenSplat after", "share")
    console().print(table("held-out photos", heads, rows))


METHODS = (OURS, SCALED, DEFAULTS)


def draw(found: list[Look], path: Path) -> None:
    """Draw PSNR over the minutes, a panel a scene."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(look.scene for look in found))
    figure = Figure(figsize=(4.2 * len(scenes), 3.6), layout="constrained")
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for panel, scene in zip(panels, scenes, strict=True):
        for method in METHODS:
            looks = looks_of(found, scene, method)
            panel.plot([look.minutes for look in looks], [look.psnr for look in looks], marker=".", label=method)
        panel.set(title=scene, xlabel="minutes of the processor", xscale="log")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("PSNR of held-out photos, dB")
    panels[0].legend(fontsize="small")
    save_figure(figure, path)


if __name__ == "__main__":
    start(main)
