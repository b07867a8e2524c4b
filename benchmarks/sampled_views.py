"""How close merging without poses comes to merging with them.

    python benchmarks/sampled_views.py RUN... [--keep 0.5 0.3 0.1 0.03]

For each run and budget, the scene is merged twice: looked at from the run's training poses, and from sampled views, as
if it were a file alone. Printed is the PSNR of both in the poses of held-out photos, at the photos' own size, against
the dense scene's renders (of what it covers) and against the photos.
"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

import torch
import tyro
from held_out import name_of, photos_of

import pointsplat_ns as ps
from pointsplat_ns.looking.view_source import MERGED_FROM
from pointsplat_ns.looking.windows import psnr_of
from pointsplat_ns.metrics import finite_psnr
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.pruning.merging import merge
from pointsplat_ns.rasterizer.scene import render_with_alpha


@torch.no_grad()
def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    /,
    keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03),
    views: int = 1000,
) -> None:
    """Print PSNR in held-out poses, merged with and without poses.

    Args:
        runs: trained runs whose data is at hand.
        keep: shares of the Gaussians that are kept.
        views: at most so many held-out photos.
    """
    print("| | kept | renders: with poses | without | difference | photos: with poses | without | difference |")
    print("|---|---|---|---|---|---|---|---|")
    differences: list[float] = []
    for run in runs:
        dense, poses = ps.load(run), dataset_views(run, "train").spread(MERGED_FROM)
        _, held_out, photos = photos_of(run, "test", views)
        drawn = [render_with_alpha(dense, view) for view in held_out]
        for share in keep:
            count = max(1, round(share * len(dense)))
            found = []
            for known in (poses, None):
                small = merge(dense, count, views=known).scene
                pictures = [ps.render(small, view) for view in held_out]
                errors = [
                    psnr_of(float((picture - image).double().square().mean()), float(alpha.double().mean()))
                    for picture, (image, alpha) in zip(pictures, drawn, strict=True)
                ]
                found.append((fmean(errors), fmean(map(finite_psnr, pictures, photos))))
            (a, b), (c, d) = found
            differences.append(c - a)
            cells = (f"{share:.0%}", *(f"{value:.2f}" for value in (a, c, c - a, b, d, d - b)))
            print(f"| {name_of(run)} | {' | '.join(cells)} |", flush=True)
    print(f"without poses, against renders: mean {fmean(differences):+.2f} dB, worst {min(differences):+.2f} dB")


if __name__ == "__main__":
    tyro.cli(main)
