"""A trade that was really measured: the example room at a few budgets, with its pictures on disk."""

import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

import pointsplat_ns as ps
from pointsplat_ns.looking.fill import fill
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.tradeoff.points import ImageMetrics, Point, Tradeoff, picture_path

BUDGETS = (("coverage", 0.9), ("coverage", 0.5), ("opacity", 0.6), ("coverage", 0.1))
SEED = 14


def write_picture(image: Tensor, path: Path) -> None:
    """Write an image (H, W, 3) in [0, 1] as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * image.clamp(0, 1)).round().to(torch.uint8).numpy()).save(path)


def room_views(width: int = 64, height: int = 48) -> ps.Views:
    """Two views into the example room. Sampling them would take ten seconds."""
    viewmats = look_at(
        torch.tensor([[1.6, -1.6, 1.8], [-0.4, 0.8, 2.0]]), torch.tensor([[0.0, 0.0, 1.2], [1.5, -1.0, 1.4]])
    )
    K = torch.tensor([[0.7 * width, 0.0, width / 2], [0.0, 0.7 * width, height / 2], [0.0, 0.0, 1.0]])
    return ps.Views(viewmats, K.repeat(2, 1, 1), width, height, torch.zeros(3))


def photo_like(image: Tensor, generator: torch.Generator) -> Tensor:
    """A render as another camera would see it: brighter, and with noise."""
    return (image**0.95 + 0.02 * torch.randn(image.shape, generator=generator)).clamp(0, 1)


def quality(images: Sequence[Tensor], references: Sequence[Tensor]) -> ImageMetrics:
    """Means over views. LPIPS is left out: it needs weights."""
    pairs = list(zip(images, references, strict=True))
    return ImageMetrics(
        statistics.fmean(float(ps.psnr(a, b)) for a, b in pairs),
        statistics.fmean(float(ps.ssim(a, b)) for a, b in pairs),
    )


@torch.no_grad()
def measured_room(
    folder: Path, scene: ps.Gaussians, budgets: Sequence[tuple[str, float]] = BUDGETS, views: ps.Views | None = None
) -> Tradeoff:
    """Measure a scene at some budgets and write the pictures."""
    generator = torch.Generator().manual_seed(SEED)
    views = room_views() if views is None else views
    dense_renders = [ps.render(scene, view) for view in views]
    photos = [photo_like(image, generator) for image in dense_renders]
    for index, photo in enumerate(photos):
        write_picture(photo, picture_path(folder, index, "photo"))
    points = []
    for by, share in (("dense", 1.0), *budgets):
        start = time.perf_counter()
        small = scene if by == "dense" else ps.prune(scene, share, by)
        seconds = time.perf_counter() - start
        renders, times = [], []
        for index, view in enumerate(views):
            start = time.perf_counter()
            renders.append(ps.render(small, view))
            times.append(1000 * (time.perf_counter() - start))
            write_picture(renders[-1], picture_path(folder, index, by if by == "dense" else f"{share:g}_{by}"))
        low, median, high = statistics.quantiles(times, n=4)
        points.append(
            Point(
                key=by if by == "dense" else f"{share:g}_{by}",
                label="dense" if by == "dense" else f"{100 * share:g} %, {by}",
                command="" if by == "dense" else f"pointsplat prune room.ply --keep {100 * share:g}% --by {by}",
                by=by,
                share=len(small) / len(scene),
                gaussians=len(small),
                sh_degree=small.sh_degree,
                repair="none",
                bytes=ply_bytes(len(small), small.sh_degree),
                against_dense=quality(renders, dense_renders),
                against_photos=quality(renders, photos),
                frame_ms=median,
                frame_ms_low=low,
                frame_ms_high=high,
                seconds=seconds,
                fill=fill(small, views),
            )
        )
    return Tradeoff(
        scene="example room",
        machine="a test machine, 1 thread",
        views_origin="sampled poses",
        width=views.width,
        height=views.height,
        points=tuple(points),
        notes=("LPIPS is missing: its weights are not at hand.",),
    )
