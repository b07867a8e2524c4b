"""Whether a point of a trade comes out the same when it is measured again: quality to the bit, times within the spread.

    python -m lab.speed.frame_times SCENE --keep 30% --times 10

The same smaller scene is judged again and again, as ``pointsplat tradeoff`` judges it. Beside times in proportion to
those of the dense scene, which is drawn in turn, stands what the clock says.
"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

import tyro

import pointsplat_ns as ps
from lab.common.printing import start
from pointsplat_ns.tradeoff.judging import Judge, LookedAt


def main(
    scene: tyro.conf.Positional[Path],
    keep: str = "30%",
    by: str = "merge",
    times: int = 10,
    views: int = 6,
    size: tuple[int, int] = (320, 240),
) -> None:
    """Judge one smaller scene several times.

    Args:
        scene: what pointsplat_ns.load takes.
        keep: how much of it.
        by: the method of pruning.
        times: how often.
        views: number of views.
        size: width and height, pixels.
    """
    dense = ps.load(scene)
    small = ps.prune(dense, keep, by)
    judge = Judge(dense, LookedAt(ps.sample_views(dense, views, *size), None, ""), None)
    found, speeds = [], []
    for number in range(times):
        judged = judge.judge(small, "", lambda share: None)
        assert judge.dense_ms is not None
        quartiles = judged.frame_ms_high, judged.frame_ms, judged.frame_ms_low
        low, speed, high = (judge.dense_ms / ms for ms in quartiles)
        found.append(judged)
        speeds.append((low, speed, high))
        print(
            f"{number + 1}: {judged.against_dense.psnr:.6f} dB, {speed:.2f} times as fast ({low:.2f} to {high:.2f}), "
            f"{judged.clock_ms:.1f} ms by the clock, others use {judged.others_cores:.1f} cores",
            flush=True,
        )
    same = all(judged.against_dense == found[0].against_dense for judged in found)
    middle, clock = [speed for _, speed, _ in speeds], [judged.clock_ms for judged in found]
    pairs = [(low <= other <= high) for low, _, high in speeds for other in middle]
    print(f"quality is {'the same to the bit' if same else 'NOT the same'} in all {times}")
    print(f"times as fast: from {min(middle):.2f} to {max(middle):.2f}, a factor of {max(middle) / min(middle):.2f}")
    print(f"by the clock: from {min(clock):.1f} to {max(clock):.1f} ms, a factor of {max(clock) / min(clock):.2f}")
    print(f"within the quartiles of another one: {fmean(pairs):.0%} of all pairs")


if __name__ == "__main__":
    start(main)
