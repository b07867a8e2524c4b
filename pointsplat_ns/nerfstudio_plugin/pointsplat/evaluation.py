"""Evaluation: variants of a scene (dense, pruned, refined) compared with its held-out photos."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.metrics import psnr, ssim
from pointsplat_ns.metrics.lpips import ReportedLpips
from pointsplat_ns.nerfstudio_plugin.frames import Frame
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import SceneGain, selection_text, verdict
from pointsplat_ns.pipeline.options import CompactOptions
from pointsplat_ns.pipeline.run import compact
from pointsplat_ns.pruning import METHODS, PruneSettings, prune
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import write_picture
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.system.terminal import print_table, say
from pointsplat_ns.system.threads import now
from pointsplat_ns.view_sampling.sampler import sample_views

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel

METRICS = ("psnr", "ssim", "lpips")

VARIANTS = ("dense", "pruned", "refined")
"""What every scene is compared in."""

COMPARED = "POINTSPLAT_COMPARE"
"""Environment variable with further ways to make the scene as small, such as ``merge compact``."""

COMPACT = "compact"

PHOTOS = "photos"
RENDERS = "dense renders"
"""What renders are compared with."""

COLUMNS = (
    ("psnr", "PSNR dB", 2),
    ("gain", "gain dB", 2),
    ("ssim", "SSIM", 3),
    ("lpips", "LPIPS", 3),
    ("gaussians", "Gaussians", 0),
    ("megabytes", "MB", 2),
    ("fps", "fps", 1),
)
"""Columns of the printed table: a value of each variant, the title, digits to show."""


@dataclass
class SceneReport:
    """Metrics of the variants of one scene, as means over its held-out photos."""

    name: str
    reference: str
    """What renders were compared with: :data:`PHOTOS` or :data:`RENDERS`."""
    views: int
    variants: dict[str, dict[str, Any]]
    """By variant: psnr (dB), ssim, lpips (None if it cannot be computed), gaussians, megabytes,
    fps, and gain: its PSNR less that of the pruned scene, dB."""
    per_view: dict[str, dict[str, list[float]]]
    """By variant and metric: one value per photo."""
    seen_in_training: bool = True


@torch.no_grad()
def evaluate_scene(
    model: PointSplatModel,
    scene: DenseScene,
    variants: dict[str, Gaussians],
    frames: Sequence[Frame],
    lpips: ReportedLpips,
    picture_folder: Path | None = None,
    progress: bool = False,
) -> SceneReport:
    """Render each variant, on the model's device, from each photo's camera of shape (1,), and
    compare the render with the photo. The model must be in evaluation mode. If LPIPS fails for one
    view, the scene has none. Images of all views go to ``picture_folder``, if it is given. Raises
    DataError if there is no photo."""
    values: dict[str, dict[str, list[float]]] = {v: {m: [] for m in METRICS} for v in variants}
    seconds: dict[str, list[float]] = {v: [] for v in variants}
    views = 0
    for camera, data in tracked(frames, f"evaluating {scene.name}", len(frames), progress):
        pictures: list[Tensor] = []
        for name, gaussians in variants.items():
            start = now(model.device)
            outputs = model.draw(gaussians, scene, camera)
            seconds[name].append(now(model.device) - start)
            photo = model.photo_of(data, outputs["background"])
            rgb = outputs["rgb"]
            pictures = [*(pictures or [photo]), rgb]
            for metric, measure in (("psnr", psnr), ("ssim", ssim), ("lpips", lpips)):
                value = measure(rgb, photo)
                values[name][metric] += [] if value is None else [float(value)]
        if picture_folder is not None:
            file = f"{scene.name}_{views:04d}.png"
            labels = ["photo" if scene.has_photos else "dense render", *variants]
            figures = ["", *(f"{values[name]['psnr'][-1]:.1f} dB" for name in variants)]
            picture = labelled(pictures, labels, figures)
            write_picture(picture, picture_folder / file, named=False)
        views += 1
    if views == 0:
        raise DataError(
            f"{scene.source}: no frame of its data is held out, so there is nothing to evaluate "
            "on; change the dataparser's split"
        )
    if any(len(per_view["lpips"]) < views for per_view in values.values()):
        for per_view in values.values():  # a mean over fewer views would not be comparable
            per_view["lpips"] = []
    rows: dict[str, dict[str, Any]] = {
        name: {metric: _mean(values[name][metric]) for metric in METRICS}
        | {"gaussians": len(gaussians), "megabytes": gaussians.megabytes}
        | {"fps": _finite(1.0 / statistics.median(seconds[name]))}
        for name, gaussians in variants.items()
    }
    for row in rows.values():
        row["gain"] = _difference(row["psnr"], rows["pruned"]["psnr"])
    return SceneReport(
        name=scene.name,
        reference=PHOTOS if scene.has_photos else RENDERS,
        views=views,
        variants=rows,
        per_view=values,
    )


def labelled(
    pictures: Sequence[Tensor], labels: Sequence[str], figures: Sequence[str] | None = None
) -> Tensor:
    """Pictures (H, W, 3) in [0, 1] side by side, with a label above each, and its figure where both
    fit: (H + L, W * count, 3) on the CPU."""
    height, width = pictures[0].shape[:2]
    size = min(max(9, width // 24), 28)
    font = ImageFont.load_default(size)
    bar = Image.new("RGB", (width * len(pictures), size + size // 2 + 2), (24, 24, 24))
    draw = ImageDraw.Draw(bar)
    for place, label in enumerate(labels):
        text = f"{label} {figures[place]}" if figures and figures[place] else label
        if draw.textlength(text, font) > width - 4:
            text = label
        draw.text((place * width + 4, size // 4), text, fill=(255, 255, 255), font=font)
    top = torch.from_numpy(np.asarray(bar, np.float32) / 255)
    return torch.cat([top, torch.cat([picture.cpu() for picture in pictures], dim=1)])


def compared_variants(scene: DenseScene, dense: Gaussians, count: int) -> dict[str, Gaussians]:
    """The scene by other ways at the same count, by their names: those that the environment
    variable :data:`COMPARED` names, pruning methods or ``compact``. Views are those of training, or
    sampled. Raises PointSplatError for another name."""
    names = os.environ.get(COMPARED, "").replace(",", " ").split()
    unknown = [name for name in names if name != COMPACT and name not in METHODS]
    if unknown:
        raise PointSplatError(
            f"{COMPARED}: no way is called {unknown[0]}; expected some of {COMPACT}, "
            f"{', '.join(METHODS)}"
        )
    if not names:
        return {}
    views = scene.views("train") if isinstance(scene, TrainedScene) else None
    found = {}
    for name in names:
        if name == COMPACT:
            options = CompactOptions(keep=count)
            found[name] = compact(dense, options, views=views, progress=True).report.scene
        else:
            seen = views if views is not None else sample_views(dense, 12)
            found[f"by {name}"] = prune(dense, count, name, seen)
    return found


def summarize(reports: list[SceneReport], with_std: bool) -> dict[str, Any]:
    """The results that ``ns-eval`` writes as JSON, with None for values that are not finite or not
    computed. Means are over the scenes that are compared with photos, or over all where there is
    none."""
    judged = [report for report in reports if report.reference == PHOTOS] or reports
    unseen = [report for report in judged if not report.seen_in_training]
    seen = [report for report in judged if report.seen_in_training]
    summary: dict[str, Any] = {}
    for metric in METRICS:
        summary[metric] = _mean([report.variants["refined"][metric] for report in unseen or judged])
        if with_std:
            per_view = [
                value for report in unseen or judged for value in report.per_view["refined"][metric]
            ]
            summary[f"{metric}_std"] = (
                _finite(statistics.stdev(per_view)) if len(per_view) > 1 else None
            )
    summary["average"] = _average(judged)
    if unseen and seen:
        summary["average_unseen"] = _average(unseen)
        summary["average_seen"] = _average(seen)
    summary["reference"] = judged[0].reference
    summary["scenes"] = {
        report.name: {
            "seen_in_training": report.seen_in_training,
            "views": report.views,
            **report.variants,
            "reference": report.reference,
        }
        for report in reports
    }
    return summary


def print_summary(summary: dict[str, Any]) -> None:
    """Print the results of ``ns-eval``: a table, the verdict, and the reason if LPIPS is
    missing."""
    settings = summary["settings"]
    scenes = summary["scenes"]
    reference = summary["reference"]
    blocks = [
        (name, "yes" if scene["seen_in_training"] else "never", str(scene["views"]), scene)
        for name, scene in scenes.items()
    ]
    if len(blocks) > 1:
        means = (("", "average"), ("yes", "average_seen"), ("never", "average_unseen"))
        blocks += [("average", seen, "", summary[key]) for seen, key in means if key in summary]
    variants = list(summary["average"])
    rows = [
        (
            *((name, seen, views) if variant == VARIANTS[0] else ("", "", "")),
            variant,
            *(_cell(scene, variant, key, digits) for key, _, digits in COLUMNS),
        )
        for name, seen, views, scene in blocks
        for variant in variants
    ]
    header = ("scene", "seen in training", "views", "variant", *(title for _, title, _ in COLUMNS))
    pruning = {name: settings[name] for name in ("keep", "by", "opacity_weight")}
    made = f"{selection_text(PruneSettings(**pruning))}; refiner {settings['size']}"
    print_table(
        header,
        rows,
        title=f"{made}; compared with {reference}",
        left=(0, 1, 3),
        section=len(variants),
    )
    if said := verdict(gains_of(summary)):
        say(said)
    others = [name for name, scene in scenes.items() if scene["reference"] != reference]
    if others:
        say(f"compared with {RENDERS}, and in no mean: {', '.join(others)}")
    if "lpips_note" in summary:
        say(f"no LPIPS: {summary['lpips_note']}")


def gains_of(summary: dict[str, Any]) -> list[SceneGain]:
    """Gains of the scenes of a summary that are in its means, and whose PSNR is finite."""
    return [
        SceneGain(
            name=name,
            trained_on=scene["seen_in_training"],
            views=scene["views"],
            pruned=scene["pruned"]["psnr"],
            refined=scene["refined"]["psnr"],
        )
        for name, scene in summary["scenes"].items()
        if scene["reference"] == summary["reference"] and scene["refined"]["gain"] is not None
    ]


def _cell(scene: dict[str, Any], variant: str, key: str, digits: int) -> str:
    """A number of the table."""
    value = scene[variant][key]
    if value is None or (key == "gain" and variant in VARIANTS[:2]):
        return "-"
    return f"{value:+,.{digits}f}" if key == "gain" else f"{value:,.{digits}f}"


def only_finite(values: dict[str, Any]) -> dict[str, float]:
    """The finite floats among the values, which nerfstudio's writers can log."""
    return {name: v for name, v in values.items() if isinstance(v, float) and math.isfinite(v)}


def _average(reports: list[SceneReport]) -> dict[str, dict[str, float | None]]:
    return {
        name: {key: _mean([r.variants[name][key] for r in reports]) for key in row}
        for name, row in reports[0].variants.items()
    }


def _difference(value: float | None, other: float | None) -> float | None:
    return None if value is None or other is None else value - other


def _mean(values: Sequence[float | None]) -> float | None:
    """Mean of the values; None if there are none, one of them is None, or the mean is not
    finite."""
    numbers = [v for v in values if v is not None]
    return _finite(sum(numbers) / len(numbers)) if numbers and len(numbers) == len(values) else None


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
