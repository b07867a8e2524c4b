"""Scenes to judge smaller ones by, and what smaller ones lose in their views."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from lab.common.compare import METRICS, metrics_of, photos_of
from lab.common.results import Results, Row
from lab.common.scenes import name_of
from lab.judge.camera_paths import path_of, views_of
from pointsplat_ns.metrics import finite_psnr
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.rendering import render, render_with_alpha
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.views import Views

PHOTOS = "photos"
"""In place of a width: the poses of held-out photos, at the photos' own size."""

LPIPS_WIDTH = 960
"""Width, pixels, above which LPIPS is not computed: it would take longer than all else."""

LEAST_WIDTH = 20
"""Pixels: a lower picture is smaller than SSIM's window."""

MEASURES = (
    "covered_psnr",
    *(f"{against}_{column}" for against in ("dense", "photo") for column in METRICS),
)
"""What is measured: PSNR of what the dense scene covers (:func:`covered_psnr`); then each metric
over all pixels, against the dense scene's renders and against photos."""

Measures = dict[str, float | None]


@dataclass(frozen=True)
class Look:
    """Views of one size."""

    at: int | str  # width in pixels, or PHOTOS
    views: Views
    photos: list[Tensor] | None = None  # [H, W, 3], one a view


@dataclass(frozen=True)
class JudgedScene:
    """A dense scene, and the views that smaller ones are compared with it in."""

    name: str
    dense: Gaussians
    looks: tuple[Look, ...]
    digest: str
    """Tells the scene and its path from others: rows of another digest are of another scene."""


def load(path: Path, widths: tuple[int, ...], count: int) -> JudgedScene:
    """A scene with at most ``count`` of its views, evenly spread.

    Args:
        path: a PLY that has a camera path of its name, looked at in every width; or a Splatfacto
            run, looked at from the poses of its held-out photos, in their size.
        widths: of the pictures of a camera path, pixels.
        count: largest number of views.

    Raises:
        SystemExit: if a PLY has no camera path.
        SceneError: if the scene cannot be read.
    """
    dense = read_scene(path)
    digest = hashlib.sha256()
    for tensor in dense.tensors():
        digest.update(tensor.contiguous().numpy().tobytes())
    if path.suffix == ".ply":
        name = path.stem
        along = path_of(path.stem)
        looks = tuple(Look(width, views_of(along, width).spread(count)) for width in widths)
        digest.update(along.read_bytes())
    else:
        name, views, photos = photos_of(path, "test", count)
        looks = (Look(PHOTOS, views, photos),)
    return JudgedScene(name, dense, looks, digest.hexdigest()[:16])


def check(paths: tuple[Path, ...]) -> list[str]:
    """The names of scenes, once it is known that each can be judged.

    Raises:
        SystemExit: if a scene is not there, a PLY has no camera path, or two scenes have one name.
        SceneError: if something is neither a PLY nor a run.
    """
    for path in paths:
        if not path.exists():
            raise SystemExit(f"{path}: no such file or folder; expected a PLY file or a run")
    names = [name_of(path) for path in paths]
    if len({*names}) < len(names):
        raise SystemExit(f"two scenes have one name: {', '.join(names)}; expected different ones")
    for path in paths:
        if path.suffix == ".ply":
            views_of(path_of(path.stem), 16)
    return names


def check_options(
    scenes: tuple[Path, ...], keep: tuple[float, ...], views: int, widths: tuple[int, ...]
) -> None:
    """Check what a program is asked for.

    Raises:
        SystemExit: if there is no scene, or a share, the number of views or a width means nothing.
    """
    if not scenes:
        raise SystemExit("no scene named; expected PLY files or runs")
    if not all(0 < share <= 1 for share in keep):
        raise SystemExit(f"--keep {' '.join(map(str, keep))}; expected shares above 0, at most 1")
    if views < 1 or not widths or min(widths) < LEAST_WIDTH:
        raise SystemExit(
            f"{views} views of widths {widths}; expected at least 1, and {LEAST_WIDTH} pixels"
        )


def known_rows(results: Results, scene: JudgedScene) -> list[Row]:
    """The rows of a scene that are there, if scene and path are the same."""
    known = results.of(scene.name)
    same = [row for row in known if row["digest"] == scene.digest]
    if known and not same:
        print(f"{scene.name}: not the scene or the path that {results.path} has; measured anew")
    return same


class DenseViews:
    """Views of a dense scene that show it, drawn once.

    Raises:
        SystemExit: if no view shows the scene.
    """

    def __init__(self, dense: Gaussians, views: Views):
        drawn = [(view, *render_with_alpha(dense, view)) for view in views]
        self.views = [
            (v, image, share)
            for v, image, alpha in drawn
            if (share := float(alpha.double().mean()))
        ]
        if not self.views:
            raise SystemExit("no view shows the scene; expected at least one")

    def psnr(self, small: Gaussians) -> float:
        """Mean over views of :func:`covered_psnr`, dB."""
        return fmean(self.psnrs(small))

    @torch.no_grad()
    def psnrs(self, small: Gaussians) -> list[float]:
        """:func:`covered_psnr` of each view, dB."""
        return [
            covered_psnr(render(small, view), image, share) for view, image, share in self.views
        ]


class PhotoViews:
    """Held-out photos of a run, and their poses: what :class:`DenseViews` is to renders."""

    def __init__(self, look: Look):
        assert look.photos is not None
        self.pairs = list(zip(look.views, look.photos, strict=True))

    def psnr(self, small: Gaussians) -> float:
        """Mean PSNR against the photos, dB."""
        return fmean(self.psnrs(small))

    @torch.no_grad()
    def psnrs(self, small: Gaussians) -> list[float]:
        """PSNR against each photo, dB."""
        return [finite_psnr(render(small, view), photo) for view, photo in self.pairs]


@torch.no_grad()
def losses(
    scene: JudgedScene, smalls: list[Gaussians], lpips: Lpips | None
) -> Iterator[tuple[int, Look, Measures]]:
    """What smaller scenes lose: the number of each, the look, and means over its views
    (:data:`MEASURES`), None where there is no photo, no LPIPS, or no pixel that the dense scene
    covers.

    The dense scene is drawn once for each look, and kept until the next.
    """
    for look in scene.looks:
        drawn = [render_with_alpha(scene.dense, view) for view in look.views]
        network = lpips if look.views.width <= LPIPS_WIDTH else None
        covered = [float(alpha.double().mean()) for _, alpha in drawn]
        renders = [image for image, _ in drawn]
        del drawn
        for number, small in enumerate(smalls):
            yield number, look, _measures(small, look, renders, covered, network)


def covered_psnr(image: Tensor, render: Tensor, covered: float) -> float:
    """PSNR, dB, of the squared error of a picture (H, W, 3) spread over the share ``covered`` of
    the pixels that the dense scene covers. Empty background does not make it better, and a halo
    beside an object makes it worse."""
    return finite_psnr(image, render) + 10 * math.log10(covered)


def _measures(
    small: Gaussians, look: Look, renders: list[Tensor], covered: list[float], lpips: Lpips | None
) -> Measures:
    values: dict[str, list[float]] = {}

    def note(found: dict[str, Any]) -> None:
        for name, value in found.items():
            values.setdefault(name, []).append(value)

    for i, view in enumerate(look.views):
        image = render(small, view)
        if covered[i] > 0:
            note({"covered_psnr": covered_psnr(image, renders[i], covered[i])})
        note(
            {f"dense_{name}": value for name, value in metrics_of(image, renders[i], lpips).items()}
        )
        if look.photos is not None:
            note(
                {
                    f"photo_{name}": value
                    for name, value in metrics_of(image, look.photos[i], lpips).items()
                }
            )
    return {name: fmean(values[name]) if name in values else None for name in MEASURES}
