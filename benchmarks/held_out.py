"""Dense scenes with the views that benchmarks judge smaller ones by, and what those views show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.io import open_run, read_scene
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.metrics import finite_psnr, ssim
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, load_lpips
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_photos
from pointsplat_ns.pruning import cut_sh
from pointsplat_ns.rasterizer import render, render_depth
from pointsplat_ns.views import View, Views

COLUMNS = ("psnr", "ssim", "lpips")
REFERENCES = ("photo", "dense")
"""What renders are compared with: held-out photos, and the dense scene's own renders of the same views."""

HALVES = ("dense_near_psnr", "dense_far_psnr")
"""PSNR against the dense renders over the nearer half of the pixels (see :func:`nearer_half`), and over the others."""

BRIGHTNESS = "dense_brightness"
"""Mean of a picture less that of the dense render, in steps of 1/255: below 0 where it got darker."""


@dataclass
class Scene:
    """A dense scene, the views it is judged in, and what they show."""

    name: str
    dense: Gaussians
    views: Views
    renders: list[Tensor]  # [H, W, 3] of the dense scene
    photos: list[Tensor] | None  # [H, W, 3]
    nearer: list[Tensor]  # [H, W] bool, see :func:`nearer_half`


@torch.no_grad()
def load(path: Path, count: int, sh: int = MAX_SH_DEGREE) -> Scene:
    """A run with at most ``count`` of its held-out photos, or a PLY with ``count`` sampled views; without the SH bands
    above a degree ``sh``."""
    dense = read_scene(path)
    dense = cut_sh(dense, sh) if dense.sh_degree > sh else dense
    photos = None
    if path.suffix == ".ply":
        name, views = path.stem, sample_views(dense, count)
    else:
        name, views, photos = photos_of(path, "test", count)
    renders = [render(dense, view) for view in views]
    return Scene(name, dense, views, renders, photos, [nearer_half(dense, view) for view in views])


def name_of(path: Path) -> str:
    """The name of a scene in the tables: that of a run, or of a PLY's file."""
    from pointsplat_ns.io import scene_name

    return path.stem if path.suffix == ".ply" else scene_name(open_run(path))


@torch.no_grad()
def nearer_half(scene: Gaussians, view: View) -> Tensor:
    """Which pixels (H, W) of a view show what is not farther than the median of the expected depths; pixels that show
    nothing at all count as farther, and not for the median."""
    depth, alpha = render_depth(scene, view)
    shown = alpha > 0
    return shown & (depth <= depth[shown].median()) if bool(shown.any()) else shown


def photos_of(path: Path, split: Literal["train", "test"], count: int) -> tuple[str, Views, list[Tensor]]:
    """The run's name, and at most ``count`` photos of a split, evenly spread, with the views that they show once
    undistorted."""
    from pointsplat_ns.io import scene_name

    views, photos = dataset_photos(path, split, count)
    return scene_name(open_run(path)), views, photos


@torch.no_grad()
def compare(scene: Scene, small: Gaussians, lpips: Lpips | None) -> dict[str, float | None]:
    """Mean metrics over the views, against the dense scene's renders (``dense_*``) and the photos (``photo_*``), with
    the :data:`HALVES` and the :data:`BRIGHTNESS`. None where there is no photo, no LPIPS or no pixel."""
    values: dict[str, list[float]] = {}
    for i, dense_render in enumerate(scene.renders):
        image = render(small, scene.views[i])
        for name, pixels in zip(HALVES, (scene.nearer[i], ~scene.nearer[i]), strict=True):
            if bool(pixels.any()):
                values.setdefault(name, []).append(finite_psnr(image[pixels][None], dense_render[pixels][None]))
        values.setdefault(BRIGHTNESS, []).append(255 * float((image.double() - dense_render.double()).mean()))
        targets = {"dense": dense_render} | ({"photo": scene.photos[i]} if scene.photos else {})
        for against, target in targets.items():
            for name, value in metrics_of(image, target, lpips).items():
                values.setdefault(f"{against}_{name}", []).append(value)
    names = [f"{against}_{column}" for against in REFERENCES for column in COLUMNS]
    return {name: fmean(values[name]) if name in values else None for name in (*names, *HALVES, BRIGHTNESS)}


@torch.no_grad()
def metrics_of(image: Tensor, target: Tensor, lpips: Lpips | None) -> dict[str, float]:
    """The metrics of one picture (H, W, 3) against another, by the names of :data:`COLUMNS`; without LPIPS where there
    is no network."""
    found = {"psnr": finite_psnr(image, target), "ssim": float(ssim(image, target))}
    return found if lpips is None else found | {"lpips": float(lpips(image, target))}


@torch.no_grad()
def mean_psnr(scene: Gaussians, views: Views, pictures: list[Tensor]) -> float:
    """Mean PSNR of a scene's renders against one picture (H, W, 3) a view, dB, each at most 100."""
    return fmean(finite_psnr(render(scene, view), picture) for view, picture in zip(views, pictures, strict=True))


def lpips_or_none(wanted: bool) -> Lpips | None:
    """LPIPS if it is wanted and its weights are at hand; says so if they are not."""
    if not wanted:
        return None
    try:
        return load_lpips("alex", download=False)
    except LpipsUnavailable as error:
        print(f"no LPIPS: {error}")
        return None
