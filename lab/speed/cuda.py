"""The rasterizer on a GPU beside gsplat's CUDA kernels: milliseconds, and how far images and gradients differ.

    python -m lab.speed.cuda

It needs CUDA, and gsplat compiles its kernels when first used, in some minutes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

import pointsplat_ns as ps
from lab.common.printing import start
from lab.common.timing import seconds_of
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.rasterizer import rasterization

LARGER = (1.0, 2.0)
"""Factors on the side of the sampled views, which is 320 pixels."""

BACKENDS = ("torch", "gsplat")


def drawn(scene: ps.Gaussians, view: ps.View, factor: float, backend: str, grads: bool) -> tuple[Tensor, list[Tensor]]:
    """An image (1, H, W, 3) and the gradients of its mean square, if wanted, for means, quats, scales, opacities and
    SH."""
    leaves = [
        t.detach().clone().requires_grad_(grads)
        for t in (scene.means, scene.quats, scene.stds, scene.alphas, scene.sh)
    ]  # fmt: skip
    K = view.K.float().clone()
    K[:2] *= factor
    image, _, _ = rasterization(
        *leaves, viewmats=view.viewmat[None].float().cuda(), Ks=K[None].cuda(), width=round(view.width * factor),
        height=round(view.height * factor), sh_degree=scene.sh_degree, backend=backend,
    )  # fmt: skip
    return image.detach(), [*torch.autograd.grad(image.square().mean(), leaves)] if grads else []


def main(scene: Path | None = None, views: int = 6, rounds: int = 3) -> None:
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
        for backend in BACKENDS:
            for grads in (False, True):
                times = [
                    [1e3 * seconds_of(partial(drawn, dense, view, factor, backend, grads)) for view in looked_from]
                    for _ in range(rounds + 1)
                ]
                counted = sorted(value for row in times[1:] for value in row)
                what = f"{round(looked_from[0].width * factor)} pixels, {backend}, image{' and gradients' * grads}"
                print(f"{what}: {median(counted):.2f} ms ({counted[0]:.2f} to {counted[-1]:.2f})", flush=True)
    image, gradients = 0.0, [0.0] * 5
    for view in looked_from:
        (ours, ours_by), (theirs, theirs_by) = (drawn(dense, view, 1.0, backend, True) for backend in BACKENDS)
        image = max(image, float((ours - theirs).abs().max()))
        relative = (float((a - b).norm() / b.norm()) for a, b in zip(ours_by, theirs_by, strict=True))
        gradients = [max(pair) for pair in zip(gradients, relative, strict=True)]
    print(f"largest difference: image {image:.1e}, gradients {', '.join(f'{g:.1e}' for g in gradients)} of their norm")


if __name__ == "__main__":
    start(main)
