"""Where float32 stops being trustworthy, against float64: rasterizer, scores, merging and refiner, over decades.

    OMP_NUM_THREADS=1 python benchmarks/stability.py --output outputs/stability

Small scenes are driven to extremes of one property each (:mod:`stability_cases`), and the errors that this makes are
measured (:mod:`stability_measures`), beside the formulas of gsplat as they are published (:mod:`classic_splatting`).
What is compared has the same input, rounded to float32 first: the error is that of the arithmetic. The truth of images
and gradients is the package's per-pixel reference in float64.
"""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import torch
import tyro
from options import write_whole
from stability_cases import SWEEPS
from stability_measures import Row, measured
from stability_report import TRUSTED, plot_others, plot_rasterizers, tables

from pointsplat_ns.io.files import replacing
from pointsplat_ns.rasterizer.compiled.blending import KERNELS
from pointsplat_ns.system.progress import progress_bar


def main(
    output: Path = Path("outputs/stability"),
    sweeps: tuple[str, ...] = tuple(sweep.name for sweep in SWEEPS),
    compiled: bool = True,
) -> None:
    """Measure errors over decades, and print how far each thing is trusted.

    Args:
        output: folder for stability.csv, stability.json, rasterizer.png and others.png; what is there is replaced.
        sweeps: which properties to drive.
        compiled: measure the compiled rasterizer too, where there is a compiler.
    """
    unknown = set(sweeps) - {sweep.name for sweep in SWEEPS}
    if unknown:
        raise SystemExit(f"no sweep {', '.join(sorted(unknown))}; expected {', '.join(s.name for s in SWEEPS)}")
    output.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    compiled = compiled and not KERNELS.why_missing
    cases = [(sweep, value) for sweep in SWEEPS if sweep.name in sweeps for value in sweep.values]
    rows: list[Row] = []
    with progress_bar() as show:
        for i, (sweep, value) in enumerate(cases):
            show("measuring", i / len(cases))
            rows += measured(sweep, value, compiled)
            write(rows, output)
    plot_rasterizers(rows, output / "rasterizer.png")
    plot_others([row for row in rows if row.part != "rasterizer"], output / "others.png")
    print(f"trusted up to a relative error of {TRUSTED}; torch {torch.__version__}, {torch.get_num_threads()} threads")
    print(f"{len(rows)} errors in {time.perf_counter() - started:.0f} s; in brackets the largest\n")
    print(tables(rows))


def write(rows: Sequence[Row], output: Path) -> None:
    """Write what was measured so far, whole."""
    with replacing(output / "stability.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    finite = [{name: _json(value) for name, value in asdict(row).items()} for row in rows]
    write_whole(output / "stability.json", {"torch": torch.__version__, "trusted": TRUSTED, "errors": finite})


def _json(value: object) -> object:
    """JSON has no infinity: null stands for what is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    tyro.cli(main)
