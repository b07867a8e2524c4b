"""The rasterizer on a GPU beside gsplat's CUDA kernels: milliseconds, and how far images and gradients differ.

    python benchmarks/cuda.py

It needs CUDA, and gsplat compiles its kernels when first used, in some minutes.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from statistics import median

import torch
import tyro
from torch import Tensor

import pointsplat_ns as ps
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.views import View

LARGER = (1.0, 2.0)
"""Factors on the side of the sampled views, which is 320 pixels."""


def compare(scene: Path | None = None, views: int = 6, rounds: int = 3) -> None:
    """Draw views by both, and print medians over views and rounds, after a round that warms up.

    Args:
        scene: file of a scene, checkpoint or run; by default the room that ships.
        views: number of sampled views.
        rounds: number of times that each is drawn.
    """
    if not torch.cuda.is_available():
        raise PointSplatError("no CUDA device; expected one, with gsplat's kernels compiled")
    dense = ps.example_room() if scene is None else ps.load(scene)
    looked_from, dense = ps.sample_views(dense, views), dense.to("cuda")
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {len(dense):,} Gaussians, {views} views")
    for factor in LARGER:
        for backend in ("torch", "gsplat"):
            for with_gradients in (False, True):
                times = [
                    [_milliseconds(dense, view, factor, backend, with_gradients) for view in looked_from]
                    for _ in range(rounds + 1)
                ]
                counted = sorted(value for row in times[1:] for value in row)
                what = "image and gradients" if with_gradients else "image"
                print(
                    f"{round(looked_from[0].width * factor)} pixels, {backend}, {what}: {median(counted):.2f} ms "
                    f"({counted[0]:.2f} to {counted[-1]:.2f})"
                )
    image, gradients = 0.0, [0.0] * 5
    for view in looked_from:
        (ours, ours_by), (theirs, theirs_by) = (_drawn(dense, view, 1.0, b, True) for b in ("torch", "gsplat"))
        image = max(image, float((ours - theirs).abs().max()))
        gradients = [
            max(worst, float((a - b).norm() / b.norm()))
            for worst, a, b in zip(gradients, ours_by, theirs_by, strict=True)
        ]
    print(f"largest difference: image {image:.1e}, gradients {', '.join(f'{g:.1e}' for g in gradients)} of their norm")


def _milliseconds(scene: Gaussians, view: View, factor: float, backend: str, with_gradients: bool) -> float:
    torch.cuda.synchronize()
    start = time.perf_counter()
    _drawn(scene, view, factor, backend, with_gradients)
    torch.cuda.synchronize()
    return 1000 * (time.perf_counter() - start)


def _drawn(
    scene: Gaussians, view: View, factor: float, backend: str, with_gradients: bool
) -> tuple[Tensor, list[Tensor]]:
    """An image (1, H, W, 3) and the gradients of its mean square, if wanted, for means, quats, scales, opacities and
    SH."""
    leaves = [
        t.detach().clone().requires_grad_(with_gradients)
        for t in (scene.means, scene.quats, scene.stds, scene.alphas, scene.sh)
    ]
    K = view.K.float().clone()
    K[:2] *= factor
    image, _, _ = rasterization(
        *leaves, viewmats=view.viewmat[None].float().cuda(), Ks=K[None].cuda(), width=round(view.width * factor),
        height=round(view.height * factor), sh_degree=scene.sh_degree, backend=backend,
    )  # fmt: skip
    if not with_gradients:
        return image, []
    return image.detach(), [*torch.autograd.grad(image.square().mean(), leaves)]


def main() -> None:
    """Run; input that cannot be used ends it with one line."""
    try:
        tyro.cli(compare)
    except PointSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
