"""Where float32 stops being trustworthy, against float64: rasterizer, scores, merging and refiner,
over decades.

    OMP_NUM_THREADS=1 python -m lab.numerics.stability --output outputs/stability

Small scenes are driven to extremes of one property each (:mod:`lab.numerics.cases`), and the errors
that this makes are measured (:mod:`lab.numerics.measures`). What is compared has the same input,
rounded to float32 first: the error is that of the arithmetic. The truth of images and gradients is
the package's per-pixel reference in float64.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path

import torch

from lab.common.printing import start
from lab.common.results import write_json
from lab.numerics.cases import SWEEPS
from lab.numerics.measures import Row, measured
from lab.numerics.report import TRUSTED, plot, tables
from pointsplat_ns.system.kernels import KERNELS
from pointsplat_ns.system.progress import tracked


def main(
    output: Path = Path("outputs/stability"),
    sweeps: tuple[str, ...] = tuple(sweep.name for sweep in SWEEPS),
    compiled: bool = True,
) -> None:
    """Measure errors over decades, and print how far each thing is trusted.

    Args:
        output: folder for stability.json, rasterizer.png and others.png; what is there is replaced.
        sweeps: which properties to drive.
        compiled: measure the compiled rasterizer too, where it was built.
    """
    unknown = set(sweeps) - {sweep.name for sweep in SWEEPS}
    if unknown:
        raise SystemExit(
            f"no sweep {', '.join(sorted(unknown))}; expected {', '.join(s.name for s in SWEEPS)}"
        )
    output.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    cases = [(sweep, value) for sweep in SWEEPS if sweep.name in sweeps for value in sweep.values]
    rows: list[Row] = []
    for sweep, value in tracked(cases, "measuring", len(cases)):
        rows += measured(sweep, value, compiled and not KERNELS.why_missing)
        errors = {"torch": torch.__version__, "trusted": TRUSTED, "errors": list(map(asdict, rows))}
        write_json(output / "stability.json", errors)
    plot(rows, output)
    print(
        f"trusted up to a relative error of {TRUSTED}; torch {torch.__version__}, "
        f"{torch.get_num_threads()} threads"
    )
    print(f"{len(rows)} errors in {time.perf_counter() - started:.0f} s; in brackets the largest\n")
    print(tables(rows))


if __name__ == "__main__":
    start(main)
