"""Variants of a scene against its held-out photos, side by side."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.cameras.cameras import Cameras
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.metrics import ImageError, psnr, ssim
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel

METRICS = ("psnr", "ssim", "lpips")


@dataclass
class SceneReport:
    """How the variants of one scene did; metrics are means over its held-out photos."""

    name: str
    views: int
    variants: dict[str, dict[str, Any]]
    """By variant: psnr (dB), ssim, lpips (None if it cannot be had), gaussians, megabytes, fps."""
    per_view: dict[str, dict[str, list[float]]]
    """By variant and metric: one value a photo."""
    seen_in_training: bool = True
    seconds: dict[str, float] = field(default_factory=dict)
    last_picture: Tensor | None = None
    """Photo and variants of the last view side by side, (H, W * (1 + variants), 3) in [0, 1]."""


@torch.no_grad()
def evaluate_scene(
    model: PointSplatModel,
    scene: TrainedScene,
    variants: dict[str, Gaussians],
    frames: Iterable[tuple[Cameras, dict]],
    progress: bool,
    picture_folder: Path | None = None,
) -> SceneReport:
    """Render each variant at each photo's camera and compare.

    Args:
        model: draws, and has LPIPS if it can be had; in evaluation mode.
        variants: by name, on the model's device.
        frames: cameras of shape (1,) and their photos.
        progress: show a bar.
        picture_folder: where to write a picture of every view, if anywhere.

    Raises:
        DataError: if there is no photo.
    """
    values: dict[str, dict[str, list[float]]] = {v: {m: [] for m in METRICS} for v in variants}
    seconds: dict[str, list[float]] = {v: [] for v in variants}
    columns = (TextColumn("evaluating {task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    lpips = model.lpips_of("alex")
    picture, views = None, 0
    with Progress(*columns, transient=True, disable=not progress) as bar:
        total = len(frames) if hasattr(frames, "__len__") else len(scene.eval_frames)
        task = bar.add_task(scene.name, total=total)
        for camera, data in frames:
            pictures = []
            for name, gaussians in variants.items():
                start = _now(model.device)
                outputs = model.draw(gaussians, scene, camera)
                seconds[name].append(_now(model.device) - start)
                photo = model.photo_of(data, outputs["background"])
                rgb = outputs["rgb"]
                pictures = pictures or [photo]
                pictures.append(rgb)
                values[name]["psnr"].append(float(psnr(rgb, photo)))
                values[name]["ssim"].append(float(ssim(rgb, photo)))
                if lpips is not None:
                    try:
                        values[name]["lpips"].append(float(lpips(rgb, photo)))
                    except ImageError as error:
                        model.lpips_reason, lpips = str(error), None
            picture = torch.cat(pictures, dim=1)
            if picture_folder is not None:
                _write_picture(picture, picture_folder / f"{scene.name}_{views:04d}.png")
            views += 1
            bar.advance(task)
    if views == 0:
        raise DataError(f"{scene.run.data}: no frame is held out, so there is nothing to evaluate on; change the split")
    rows = {}
    for name, gaussians in variants.items():
        # LPIPS that failed at one view is not known for all, and no mean of the others is comparable.
        complete = {metric: per_view if len(per_view) == views else [] for metric, per_view in values[name].items()}
        rows[name] = {metric: _mean(complete[metric]) for metric in METRICS}
        rows[name] |= {"gaussians": len(gaussians), "megabytes": gaussians.megabytes}
        rows[name]["fps"] = 1.0 / statistics.median(seconds[name])
    return SceneReport(scene.name, views, rows, values, last_picture=picture)


def summarize(reports: list[SceneReport], with_std: bool) -> dict[str, Any]:
    """What ``ns-eval`` writes: valid JSON, with None for what is not finite or not known."""
    unseen = [r for r in reports if not r.seen_in_training]
    seen = [r for r in reports if r.seen_in_training]
    judged = unseen or reports
    summary: dict[str, Any] = {}
    for metric in METRICS:
        summary[metric] = _mean([r.variants["refined"][metric] for r in judged])
        if with_std:
            per_view = [value for r in judged for value in r.per_view["refined"][metric]]
            summary[f"{metric}_std"] = _finite(statistics.stdev(per_view)) if len(per_view) > 1 else None
    summary["average"] = _average(reports)
    if unseen and seen:
        summary["average_unseen"], summary["average_seen"] = _average(unseen), _average(seen)
    summary["scenes"] = {
        r.name: {
            "seen_in_training": r.seen_in_training,
            "views": r.views,
            **{name: {k: _finite(v) for k, v in row.items()} for name, row in r.variants.items()},
            "seconds": r.seconds,
        }
        for r in reports
    }
    return summary


def _average(reports: list[SceneReport]) -> dict[str, dict[str, float | None]]:
    """Means over scenes, by variant."""
    return {
        name: {key: _mean([r.variants[name][key] for r in reports]) for key in row}
        for name, row in reports[0].variants.items()
    }


def _mean(values: list[float | None]) -> float | None:
    """Mean of numbers; None if there is none, one is unknown, or the mean is not finite."""
    known = [v for v in values if v is not None]
    return _finite(sum(known) / len(known)) if known and len(known) == len(values) else None


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _write_picture(picture: Tensor, path: Path) -> None:
    from torchvision.utils import save_image

    path.parent.mkdir(parents=True, exist_ok=True)
    save_image(picture.permute(2, 0, 1).cpu(), path)
