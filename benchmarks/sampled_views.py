"""How well views sampled in free space stand for the poses that photos are taken from.

    python benchmarks/sampled_views.py RUN_OR_PLY...

For each budget: PSNR of the merged scene against the dense scene's own renders, in two sets of sampled views and, for a
run whose data is at hand, in the poses of its held-out photos and against these photos. And how much of the scene the
sampled views show: the share of its opacity times area on Gaussians that get at least a tenth of a pixel of blend
weight (opacity times the transmittance in front) over all views.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from held_out import mean_psnr, name_of, photos_of
from torch import Tensor

import pointsplat_ns as ps
from pointsplat_ns.gaussians import SH_C0
from pointsplat_ns.pruning.scores import area_score

SEEN_PIXELS = 0.1
"""Blend weight, in pixels, from which a Gaussian counts as seen."""

SEEDS = (0, 1)
"""Of the sampled views."""


@dataclass(frozen=True)
class Judged:
    """Views of a dense scene, and the pictures that smaller scenes are compared with there."""

    name: str
    views: ps.Views
    pictures: list[Tensor]  # [H, W, 3]

    def psnr(self, scene: ps.Gaussians) -> float:
        """Mean PSNR over the views, dB."""
        return mean_psnr(scene, self.views, self.pictures)


@torch.no_grad()
def judged_in(path: Path, dense: ps.Gaussians, count: int, side: int) -> list[Judged]:
    """The sets of views that a scene is judged in."""

    def rendered(name: str, views: ps.Views) -> Judged:
        views = views.resized(side)
        return Judged(name, views, [ps.render(dense, view) for view in views])

    sets = [rendered(f"sampled, seed {seed}", ps.sample_views(dense, count, seed=seed)) for seed in SEEDS]
    if path.suffix != ".ply":
        _, views, photos = photos_of(path, "test", count)
        sets += [rendered("held-out poses", views), Judged("held-out photos", views, photos)]
    return sets


def share_seen(scene: ps.Gaussians, views: ps.Views) -> float:
    """Share of the opacity times area of a scene that is on Gaussians seen in any of the views."""
    weight = torch.zeros(len(scene), dtype=torch.float64)
    black = dataclasses.replace(views, background=torch.zeros(3))
    for view in black:
        # The gradient of the sum of one channel by a Gaussian's value in it is its blend weight.
        grey = torch.zeros_like(scene.features_dc, requires_grad=True)
        with torch.enable_grad():
            image = ps.render(scene.replace(features_dc=grey, features_rest=scene.features_rest[:, :0]), view)
            total = image[..., 0].sum()
        weight += torch.autograd.grad(total, grey)[0][:, 0].double() / SH_C0
    mass = area_score(scene).exp().nan_to_num(nan=0.0)
    return float(mass[weight >= SEEN_PIXELS].sum() / mass.sum())


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    /,
    keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03),
    views: int = 12,
    side: int = 320,
) -> None:
    """Print, for each scene, how sampled views judge merged scenes and how held-out ones do.

    Args:
        scenes: trained runs, or PLYs, which have no held-out photos.
        keep: shares of the Gaussians that are kept.
        views: number of views of each set, at most.
        side: longer side of renders, pixels; photos keep their size.
    """
    for path in scenes:
        dense = ps.load(path)
        start = time.perf_counter()
        sampled = ps.sample_views(dense, views)
        seconds = time.perf_counter() - start
        sets = judged_in(path, dense, views, side)
        print(
            f"\n{name_of(path)}: {len(dense):,} Gaussians; {len(sampled)} views sampled in {seconds:.1f} s show",
            end=" ",
        )
        print(f"{share_seen(dense, sampled.resized(side)):.1%} of opacity x area\n")
        print("| PSNR, dB | " + " | ".join(f"{share:.0%}" for share in keep) + " |")
        print("|---|" + "---|" * len(keep))
        small = [ps.prune(dense, share) for share in keep]
        for judged in sets:
            print(f"| {judged.name} | " + " | ".join(f"{judged.psnr(scene):.1f}" for scene in small) + " |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
