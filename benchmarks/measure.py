"""Clocks, memory, and the work that a picture needs, for the benchmarks."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN, BLENDED_AT_ONCE, TILE, TRANSMITTANCE_MIN
from pointsplat_ns.rasterizer.projection import Projected
from pointsplat_ns.rasterizer.tiles import TileList

FORWARD_FMAS = 7
"""Multiply-adds that a needed pair costs at the least, beside one exp: 2 for the exponent (Horner's rule along a
row), 2 for weight and transmittance, 3 for the colour."""
BACKWARD_FMAS = 16
"""And in the backward pass, with alpha and transmittance kept: 3 for colour times gradient, 3 for the colour's
gradient, 4 for what lies behind and the gradient of log alpha, 6 for the sums of the quadratic's coefficients."""


_clock = time.perf_counter


def use_cpu_time() -> None:
    """From now on the clock counts CPU seconds of this process, which others on the machine do not stretch."""
    global _clock
    _clock = time.process_time


def now() -> float:
    """Seconds on the clock, after all work on a GPU is done."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return _clock()


def timed(
    functions: dict[str, Callable[[], dict[str, float]]], repeats: int, budget: float, fastest: bool = False
) -> dict[str, float]:
    """Call every function once a round and take medians, so that a busy moment of the machine hits all alike.

    Args:
        functions: each measures itself and returns seconds by name.
        repeats: rounds counted; one more comes before them, to warm up.
        budget: seconds after which no new round is begun. At least one round is counted: the first if it alone
            took more than half of the budget.
        fastest: take the fastest round of each figure in place of the median.
    """
    begin = time.perf_counter()
    rounds: list[dict[str, float]] = []
    for i in range(repeats + 1):
        seconds: dict[str, float] = {}
        for function in functions.values():
            seconds |= function()
        spent = time.perf_counter() - begin
        if i > 0 or spent > budget / 2:
            rounds.append(seconds)
        if rounds and spent + spent / (i + 1) > budget:
            break
    choose = min if fastest else statistics.median
    return {name: choose([r[name] for r in rounds]) for name in rounds[0]}


def peak_extra_bytes(function: Callable[[], object], device: torch.device) -> int | None:
    """Memory that ``function`` takes at its highest above what was held before; None where it cannot be known.

    On a CPU: the resident high-water mark of the process (Linux), after giving freed memory back.
    """
    if device.type == "cuda":
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        function()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark to what is resident now
        before = _status("VmHWM")
        function()
        return max(0, _status("VmHWM") - before)
    except (OSError, AttributeError):
        return None


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"/proc/self/status has no {field}")


def floor_costs(device: torch.device, repeats: int = 30) -> dict[str, float]:
    """Seconds an element that one exp and one multiply-add cost at their best, with the threads in use.

    The exp runs in place over a tensor that stays in the caches; the multiply-adds are a matrix product that
    does, the fastest that they can be had.
    """
    size = 2**16 if device.type == "cpu" else 2**22
    side = 512 if device.type == "cpu" else 4096
    values, out = torch.rand(size, device=device) - 1.0, torch.empty(size, device=device)
    left, right, product = (torch.rand(side, side, device=device) for _ in range(3))

    def best(function) -> float:
        times = []
        for _ in range(repeats):
            start = now()
            function()
            times.append(now() - start)
        return min(times)

    return {
        "exp": best(lambda: [torch.exp(values, out=out) for _ in range(10)]) / (10 * size),
        "fma": best(lambda: torch.mm(left, right, out=product)) / side**3,
    }


@torch.no_grad()
def count_pairs(seen: Projected, tiles: TileList, width: int, height: int) -> dict[str, int]:
    """The work of one image of one camera.

    Returns:
        visible: Gaussians that touch a tile.
        tile_pairs: tile-Gaussian pairs.
        needed: Gaussian-pixel pairs with alpha >= 1/255 on a pixel that is not finished.
        evaluated: pixels of a tile for each of its pairs, up to the end of the chunk that finishes the tile.
    """
    ids, ends = tiles.gaussians, tiles.offsets
    lengths, order = torch.sort(ends[1:] - ends[:-1], descending=True, stable=True)
    starts = ends[:-1][order]
    columns = -(-width // TILE)
    axis = torch.arange(TILE, device=ids.device)
    pixel_y, pixel_x = (grid.reshape(-1) for grid in torch.meshgrid(axis, axis, indexing="ij"))
    values = torch.cat([seen.means2d, seen.conics, seen.opacities[:, None]], dim=1)

    needed = evaluated = 0
    block = max(1, 2**22 // (BLENDED_AT_ONCE * TILE * TILE))
    for begin in range(0, int((lengths > 0).sum()), block):
        of = torch.arange(begin, min(begin + block, len(order)), device=ids.device)
        of = of[lengths[of] > 0]
        x = (order[of] % columns * TILE)[:, None] + pixel_x
        y = (order[of] // columns * TILE)[:, None] + pixel_y
        inside = (x < width) & (y < height)
        through = inside.float()
        first = 0
        while of.numel():
            left = (lengths[of] - first).clamp_max(BLENDED_AT_ONCE)
            step = torch.arange(BLENDED_AT_ONCE, device=ids.device)
            there = step < left[:, None]
            place = (starts[of][:, None] + first + step).clamp_max(ids.numel() - 1)
            alpha = _alphas(values[ids[place]], x, y).masked_fill_(~there[..., None], 0.0)
            after = through[:, None] * torch.cumprod(1 - alpha, dim=1)
            needed += int(((alpha > 0) & (after > TRANSMITTANCE_MIN)).sum())
            evaluated += int(left.sum()) * TILE * TILE
            through = after[:, -1].where(after[:, -1] > TRANSMITTANCE_MIN, torch.zeros_like(through))
            first += BLENDED_AT_ONCE
            go = (through > 0).any(1) & (lengths[of] > first)
            of, x, y, through = of[go], x[go], y[go], through[go]
    visible = int(torch.unique(ids).numel())
    return {"visible": visible, "tile_pairs": ids.numel(), "needed": needed, "evaluated": evaluated}


def _alphas(values: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Alphas (B, S, pixels), 0 below 1/255, of Gaussians (B, S, 6) at the centres of pixels x, y (B, pixels)."""
    mx, my, a, b, c, opacity = (v.unsqueeze(-1) for v in values.unbind(-1))
    dx, dy = x[:, None] + 0.5 - mx, y[:, None] + 0.5 - my
    alpha = (opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp_max(ALPHA_MAX)
    return alpha.masked_fill_(alpha < ALPHA_MIN, 0.0)
