"""Time of the rasterizer by stage, on Gaussians spread over the walls of a room.

    python benchmarks/rasterizer.py --gaussians 150000 --width 640 --height 480

Machines differ and are shared: compare figures of one run. The last line gives the stages as shares of the forward.
"""

from __future__ import annotations

import statistics
import time

import torch
import tyro

from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.blending import blend
from pointsplat_ns.rasterizer.projection import project
from pointsplat_ns.rasterizer.tiles import intersect_tiles


def room(count: int, seed: int = 0) -> list[torch.Tensor]:
    """Means, quats, scales, opacities and SH (degree 3) on the six walls of a 6 x 3 x 6 room."""
    g = torch.Generator().manual_seed(seed)
    half = torch.tensor([3.0, 1.5, 3.0])
    means = (2 * torch.rand(count, 3, generator=g) - 1) * half
    axis = torch.randint(0, 3, (count,), generator=g)
    side = 2.0 * torch.randint(0, 2, (count,), generator=g) - 1
    means[torch.arange(count), axis] = side * half[axis]
    quats = torch.randn(count, 4, generator=g)
    scales = 0.6 * (108 / count) ** 0.5 * torch.exp(0.7 * torch.randn(count, 3, generator=g))
    opacities = 0.05 + 0.9 * torch.rand(count, generator=g)
    return [means, quats, scales, opacities, 0.1 * torch.randn(count, 16, 3, generator=g)]


def median_seconds(function, repeats: int) -> float:
    """Median wall time of some calls, after one that is not counted."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def main(gaussians: int = 150_000, width: int = 640, height: int = 480, repeats: int = 5) -> None:
    """Print forward, backward and stage times."""
    scene = [t.requires_grad_() for t in room(gaussians)]
    K = torch.tensor([[0.6 * width, 0, width / 2], [0, 0.6 * width, height / 2], [0, 0, 1.0]])
    view = torch.eye(4)
    view[2, 3] = 2.0

    def forward(absgrad: bool = False):
        return rasterization(*scene, view[None], K[None], width, height, sh_degree=3, packed=False, absgrad=absgrad)

    ahead = median_seconds(forward, repeats)
    for absgrad in (False, True):
        both = median_seconds(lambda: forward(absgrad)[0].mean().backward(), repeats)  # noqa: B023
        print(f"forward {ahead:.3f} s, backward{' with absgrad' if absgrad else ''} {both - ahead:.3f} s")
    with torch.no_grad():
        seen = project(*scene[:4], view, K, width, height)
        geometry = (seen.means2d, seen.cov2d, seen.det, seen.opacities)
        cameras = torch.zeros_like(seen.ids)
        tiles = intersect_tiles(*geometry, seen.depths, cameras, 1, width, height)
        colors = torch.rand(len(seen.ids), 3)
        stages = {
            "projection": lambda: project(*scene[:4], view, K, width, height),
            "tiles": lambda: intersect_tiles(*geometry, seen.depths, cameras, 1, width, height),
            "blending": lambda: blend(*geometry, colors, tiles, 1, width, height),
        }
        seconds = {name: median_seconds(stage, repeats) for name, stage in stages.items()}
    print(f"{gaussians:,} Gaussians, {len(seen.ids):,} visible, {tiles.gaussians.numel():,} pairs with tiles")
    print(", ".join(f"{name} {s:.3f} s ({100 * s / ahead:.0f} %)" for name, s in seconds.items()))


if __name__ == "__main__":
    tyro.cli(main)
