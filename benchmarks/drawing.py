"""What it gains and loses to draw smaller scenes fast, or at half the resolution.

    python benchmarks/drawing.py SCENE... --keep 100% 50% 30% 10% 3%

Speed is against the dense scene drawn exactly, in turn with it, as ``pointsplat tradeoff`` measures it; PSNR is against
the dense scene's renders. The rows that no other row of a scene beats in both are marked.
"""

from __future__ import annotations

from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

import pointsplat_ns as ps
from pointsplat_ns.tradeoff.judging import Judge, LookedAt
from pointsplat_ns.tradeoff.settings import DRAWN


def main(
    scenes: tuple[Path, ...],
    /,
    keep: tuple[str, ...] = ("100%", "50%", "30%", "10%", "3%"),
    views: int = 4,
    size: tuple[int, int] = (320, 240),
) -> None:
    """Draw merged scenes in each way.

    Args:
        scenes: what pointsplat_ns.load takes.
        keep: budgets of merging.
        views: number of views.
        size: width and height, pixels.
    """
    for path in scenes:
        dense = ps.load(path)
        judge = Judge(dense, LookedAt(ps.sample_views(dense, views, *size), None, ""), None)
        rows: list[tuple[str, str, float, float]] = []
        for budget in keep:
            small = dense if budget == "100%" else ps.prune(dense, budget)
            for drawn in DRAWN:
                judged = judge.judge(small, "", lambda share: None, drawn=drawn)
                assert judge.dense_ms is not None
                rows.append((budget, drawn, judged.against_dense.psnr, judge.dense_ms / judged.frame_ms))
        table = Table("kept", "drawn", "PSNR, dB", "times as fast", "on the front", title=f"{path.stem}, {size}")
        for budget, drawn, psnr, speed in rows:
            beaten = any(other[2] >= psnr and other[3] > speed for other in rows)
            table.add_row(budget, drawn, f"{psnr:.2f}", f"{speed:.2f}", "" if beaten else "*")
        Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
