"""What Adam's step takes when its averages are below the smallest normal float32, as those of unseen Gaussians become.

    OMP_NUM_THREADS=1 python -m lab.numerics.small_numbers

A gradient comes once, and then none; the averages fall by a tenth a step.
"""

from __future__ import annotations

import contextlib
import time

import torch

from lab.common.printing import start as start_program
from pointsplat_ns.system.small_numbers import tiny_as_zero


def main(gaussians: int = 80_000, numbers: int = 45, steps: tuple[int, ...] = (10, 500, 999)) -> None:
    """Print CPU milliseconds of some steps, as they are and with such numbers as 0.

    Args:
        gaussians: how many.
        numbers: of each, such as the SH coefficients above degree 0.
        steps: which to print.
    """
    torch.set_num_threads(1)
    for name, context in (("as they are", contextlib.nullcontext()), ("as 0", tiny_as_zero())):
        values = torch.nn.Parameter(torch.randn(gaussians, numbers))
        adam = torch.optim.Adam([values], fused=True)
        with context:
            for step in range(max(steps) + 1):
                values.grad = torch.full_like(values, 1e-6 * (step == 0))
                start = time.process_time()
                adam.step()
                if step in steps:
                    print(f"{name}, step {step}: {1e3 * (time.process_time() - start):.1f} ms", flush=True)


if __name__ == "__main__":
    start_program(main)
