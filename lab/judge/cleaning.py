"""What `clean` does in photos that no training saw, at several strengths.

    python -m lab.judge.cleaning outputs/meeting/splatfacto-cpu/RUN outputs/ray/splatfacto-cpu/RUN
    python -m lab.judge.cleaning RUN --strengths 1 --sampled

Held-out photos among the training photos say what a scene loses. Photos outside of these say what
it gains: train on the others, with ``train_filenames`` and ``test_filenames`` in
``transforms.json``; held out was the fifth of the photos that lies farthest along the first
principal axis of the cameras' positions.
"""

from __future__ import annotations

from pathlib import Path
from statistics import mean
from typing import Annotated

import torch
import tyro

import pointsplat_ns as ps
from lab.common.compare import metrics_of, photos_of
from lab.common.printing import console, number, start, table
from lab.common.scenes import group_of
from lab.tables.scenes import Pictures
from pointsplat_ns.pipeline.cleaning import floating_scores
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.rendering import render
from pointsplat_ns.system.tensors import normal_mode


@normal_mode
@torch.no_grad()
def main(
    runs: Annotated[list[Path], tyro.conf.Positional],
    strengths: tuple[float, ...] = (0.5, 1.0),
    sampled: bool = False,
    photos: int = 8,
    side: int = 320,
) -> None:
    """Print the change of PSNR and SSIM in held-out photos without floaters.

    Args:
        runs: folders of trained runs whose data is at hand.
        strengths: of floaters.
        sampled: find floaters in sampled views, in place of those of the training photos.
        photos: largest number of photos.
        side: longer side that photos are reduced to, pixels.
    """
    for run in runs:
        dense = ps.load(run)
        name, *whole = photos_of(run, "test", photos)
        held_out = Pictures(*whole).resized(side)

        def measured(scene: ps.Gaussians, held_out: Pictures = held_out) -> dict[str, list]:
            pairs = zip(held_out.views, held_out.photos or (), strict=True)
            found = [metrics_of(render(scene, view), photo, None) for view, photo in pairs]
            return {key: [metrics[key] for metrics in found] for key in ("psnr", "ssim")}

        before = measured(dense)
        source = ViewProvider(dense, run=None if sampled else run)
        scores, _ = floating_scores(dense, source.scored(VIEW_COUNTS.scored))
        rows = []
        for strength in strengths:
            after = measured(dense[scores >= strength])
            psnr, ssim = (
                [b - a for a, b in zip(before[key], after[key], strict=True)] for key in before
            )
            changes = map(number(3, sign="+"), (mean(psnr), min(psnr), max(psnr), mean(ssim)))
            rows.append(
                [
                    f"{strength:g}",
                    number(2)(100 * float((scores < strength).double().mean())),
                    *changes,
                ]
            )
        heads = ("strength", "removed, %", "PSNR, dB", "worst photo", "best photo", "SSIM")
        title = (
            f"{name} ({group_of(name)}): {mean(before['psnr']):.2f} dB in {len(held_out.views)} "
            "held-out photos"
        )
        console().print(table(title, heads, rows))


if __name__ == "__main__":
    start(main)
