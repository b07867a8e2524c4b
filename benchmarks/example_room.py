"""What is lost of the example room at several budgets, as the README shows it.

    python benchmarks/example_room.py
    python benchmarks/example_room.py --splat-transform node_modules/.bin/splat-transform

PSNR is over all pixels of twelve sampled views, against the scene's own renders: no photos are needed, and the figures
are the same in every run. They are other views than those in which ``compact`` decides how far to refine. Seconds are
of this machine, with that decision.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import pointsplat_ns as ps
from pointsplat_ns.compression.closeness import DenseReference
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.tables.splat_transform import NAME, SplatTransform

VIEWS, SEED = 12, 1
"""What is judged in. ``compact`` samples its own views with seed 0."""


@dataclass(frozen=True)
class Row:
    """One method at one budget."""

    method: str
    keep: float
    psnr: float
    """dB, over all pixels of all views."""
    megabytes: float
    """Of the PLY, 10^6 bytes."""
    seconds: float
    note: str = ""


def rows(scene: ps.Gaussians, keeps: tuple[float, ...], peer: SplatTransform | None) -> Iterator[Row]:
    """A row for each method and budget."""
    reference = DenseReference(scene, ps.sample_views(scene, VIEWS, seed=SEED))
    refiner = ps.load_refiner(device="cpu")

    def row(method: str, keep: float, small: ps.Gaussians, seconds: float, note: str = "") -> Row:
        return Row(method, keep, reference.psnr(small)[0], megabytes(small), seconds, note)

    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "room.ply"
        ps.save(scene, source)
        for keep in keeps:
            for name, by in (
                ("`prune` (merge)", "merge"),
                ("`prune --by coverage`", "coverage"),
                ("`prune --by paper` (eq. 3)", "paper"),
            ):
                start = time.perf_counter()
                small = ps.prune(scene, keep, by)
                yield row(name, keep, small, time.perf_counter() - start)
            result = ps.compact(scene, keep, refiner, by="merge")
            note = f"accepted at {result.strength:.0%}" if result.accepted else "left out"
            yield row("`compact`", keep, result.scene, result.seconds, note)
            for mode in peer.modes if peer is not None else ():
                small, usage = mode.reduce(source, max(1, round(keep * len(scene))))
                yield row(mode.label, keep, small, usage.seconds)


def megabytes(scene: ps.Gaussians) -> float:
    """Of a scene's 3DGS PLY, 10^6 bytes."""
    return ply_bytes(len(scene), scene.sh_degree) / 1e6


def markdown(title: str, found: list[Row], keeps: tuple[float, ...], cell) -> str:
    """A table with a line for each method and a column for each budget."""
    lines = [f"| {title} | {' | '.join(f'{100 * keep:g} %' for keep in keeps)} |", "|---" * (1 + len(keeps)) + "|"]
    for method in sorted({row.method for row in found}, key=_place):
        of = {row.keep: row for row in found if row.method == method}
        lines.append(f"| {method} | {' | '.join(cell(of[keep]) for keep in keeps)} |")
    return "\n".join(lines)


def _place(method: str) -> tuple[int, str]:
    """Where a method stands in the tables."""
    shown = ("`prune` (merge)", "`compact`", NAME, "`prune --by coverage`", "`prune --by paper`")
    return next(index for index, start in enumerate(shown) if method.startswith(start)), method


@torch.no_grad()
def main(keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03), splat_transform: str | None = None) -> None:
    """Print what is lost of the example room, as Markdown tables.

    Args:
        keep: shares of the Gaussians to keep.
        splat_transform: the program, for a line of its decimation.
    """
    scene = ps.example_room()
    peer = None if splat_transform is None else SplatTransform(splat_transform)
    if peer is not None and peer.missing:
        raise SystemExit(f"{NAME}: {peer.missing}")
    found = list(rows(scene, keep, peer))
    size = f"{len(scene):,} Gaussians of SH degree {scene.sh_degree}, {megabytes(scene):.2f} MB"
    print(f"The example room, {size}; {VIEWS} sampled views; {torch.get_num_threads()} threads.\n")
    print(markdown("PSNR, dB", found, keep, lambda row: f"{row.psnr:.1f}"), end="\n\n")
    accepted = [row for row in found if row.note]
    print(markdown("refinement", accepted, keep, lambda row: row.note), end="\n\n")
    print(markdown("PLY, MB", found, keep, lambda row: f"{row.megabytes:.2f}"), end="\n\n")
    print(markdown("seconds", found, keep, lambda row: f"{row.seconds:.1f}"))


if __name__ == "__main__":
    tyro.cli(main)
