"""Metrics of pictures, and the photos of trained runs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.metrics import finite_psnr, ssim
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, load_lpips
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.scene.runs import open_run, scene_name
from pointsplat_ns.scene.views import Views
from pointsplat_ns.tools.tradeoff.measuring import photos_with_views

METRICS = ("psnr", "ssim", "lpips")


def dataset_photos(
    path: Path | str, split: Literal["train", "test"], count: int, data: Path | str | None = None
) -> tuple[Views, list[Tensor]]:
    """At most ``count`` photos (H, W, 3) in [0, 1] of a run's dataset, evenly spread, and their
    views on the CPU; of photos of several sizes, those of the most common one."""
    views, photos = photos_with_views(run_photos(path, split, data), count)
    common = views.image_sizes()[0]
    of_size = [index for index, size in enumerate(views.size_of_each()) if size == common]
    return views[of_size], [photos[index].target for index in of_size]


def photos_of(
    path: Path, split: Literal["train", "test"], count: int
) -> tuple[str, Views, list[Tensor]]:
    """The run's name, and at most ``count`` photos (H, W, 3) of a split, evenly spread, with the
    views that they show once undistorted."""
    views, photos = dataset_photos(path, split, count)
    return scene_name(open_run(path)), views, photos


@torch.no_grad()
def metrics_of(image: Tensor, target: Tensor, lpips: Lpips | None) -> dict[str, float]:
    """The :data:`METRICS` of one picture (H, W, 3) against another; without LPIPS where there is no
    network."""
    found = {"psnr": finite_psnr(image, target), "ssim": float(ssim(image, target))}
    return found if lpips is None else found | {"lpips": float(lpips(image, target))}


def lpips_or_none(wanted: bool) -> Lpips | None:
    """LPIPS if it is wanted and its weights are at hand; says so if they are not."""
    if not wanted:
        return None
    try:
        return load_lpips("alex", download=False)
    except LpipsUnavailable as error:
        print(f"no LPIPS: {error}")
        return None
