"""Time, memory and work of the refiner against the number of Gaussians, in one run with the machine's matrix rate.

    python benchmarks/refiner.py                                        # all sizes; about three minutes
    python benchmarks/refiner.py --sizes small --counts 59000 --threads 2
    python benchmarks/refiner.py --full --json out.json --plot out.png  # every size at every count, training as well

Inference is `refiner(scene, structure)` without gradients; a training step is forward and backward of a sum over the
refined parameters; the structure (serialization and neighbour tables) is made once per scene and timed apart. Shares
are of one inference together with its structure. Set GOMP_SPINCOUNT=20000 when several
threads run on a busy machine: threads that wait spin, and can cost a hundredfold.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # before torch: its profiler complains of a missing GPU

import torch
import tyro
from measure import now, peak_extra_bytes
from options import Options, write_json
from report import console, slope
from rich.table import Table
from scenes import room
from torch import nn

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner import PRESETS, Refiner, Structure, preset
from pointsplat_ns.refiner.heads import ResidualHeads
from pointsplat_ns.refiner.point_transformer import PatchAttention, SubmanifoldConv

COUNTS = (1_000, 3_000, 10_000, 30_000, 59_000, 100_000, 300_000)
PLAN = {"tiny": COUNTS, "small": COUNTS, "full": (1_000, 10_000, 30_000)}
"""Counts of a default run: the published size is left out where one inference takes a minute."""
TRAIN_UP_TO = {"tiny": 100_000, "small": 59_000, "full": 1_000}
"""Most Gaussians of a training step in a default run."""
SLOPE_FROM = 10_000
"""A second slope, next to that of all counts, leaves out fewer Gaussians than this: there, fixed costs and half-filled
patches make the curve flatter."""
MATRIX_KERNELS = ("aten::addmm", "aten::mm", "aten::bmm", "aten::baddbmm")
PARTS = ("attention", "convolution", "heads", "structure", "rest")
PART_OF: dict[type[nn.Module], str] = {
    PatchAttention: "attention",
    SubmanifoldConv: "convolution",
    ResidualHeads: "heads",
}


@dataclass
class Args(Options):
    """Time the refiner by size and number of Gaussians."""

    sizes: tuple[str, ...] = tuple(PRESETS)
    """Sizes of the network: tiny, small, full."""
    counts: tuple[int, ...] | None = None
    """Numbers of Gaussians, for every size; a choice that takes about three minutes by default."""
    full: bool = False
    """Every size at every count, training steps included."""
    bf16: bool = False
    """Time inference under bfloat16 autocast as well, and its error against float32."""
    repeats: int = 3
    """Rounds at most; medians are reported."""
    budget: float = 4.0
    """Seconds after which a figure is content with the rounds that it has."""


@dataclass
class Result:
    """One size at one count. Seconds, bytes, floating-point operations."""

    size: str
    gaussians: int
    prepare: float
    inference: float
    flops: int
    rate: float
    """Operations a second of plain matrix products, measured just before."""
    shares: dict[str, float]
    matrix_seconds: float
    """Seconds of one inference within matrix products and attention kernels, as torch's profiler counts them."""
    inference_bytes: int | None
    step: float | None = None
    step_bytes: int | None = None
    bf16: dict[str, float] = field(default_factory=dict)

    @property
    def efficiency(self) -> float:
        """Share of the measured matrix rate that the matrix work of an inference reaches."""
        return self.flops / (self.rate * self.matrix_seconds) if self.matrix_seconds else float("nan")


def room_gaussians(count: int, device: torch.device) -> Gaussians:
    """The synthetic room of :mod:`scenes`, in the container's parametrisation."""
    means, quats, scales, opacities, sh = room(count)
    parts = means, scales.log(), quats, opacities.logit()[:, None], sh[:, 0].clone(), sh[:, 1:].clone()
    return Gaussians(*(part.to(device) for part in parts))


def awake(size: str, device: torch.device) -> Refiner:
    """A refiner whose last layers are not zero, so that the size of rounding errors shows."""
    torch.manual_seed(0)
    refiner = Refiner(preset(size)).eval()
    with torch.no_grad():
        for mlp in refiner.heads.mlps.values():
            mlp[-1].weight.normal_(std=0.01)
    return refiner.to(device)


def matrix_rate(device: torch.device, dtype: torch.dtype = torch.float32, seconds: float = 0.3) -> float:
    """Operations a second of square matrix products, the best of as many as fit into the time."""
    side = 1024 if device.type == "cpu" else 8192
    left, right, out = (torch.randn(side, side, device=device).to(dtype) for _ in range(3))
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = now()
        torch.mm(left, right, out=out)
        best = min(best, now() - start)
    return 2 * side**3 / best


def measured(function: Callable[[], object], repeats: int, budget: float, device: torch.device) -> tuple:
    """Median seconds of up to ``repeats`` calls and the bytes that the call before them took at its peak.

    That first call warms up; it counts as well where it alone takes half of the budget.
    """
    times: list[float] = []

    def timed_call() -> None:
        start = now()
        function()
        times.append(now() - start)

    held = peak_extra_bytes(timed_call, device)
    if not times:  # memory cannot be measured here
        timed_call()
    while times[0] < budget / 2 and len(times) <= repeats and sum(times) + times[-1] < budget:
        timed_call()
    return statistics.median(times[1:] or times), held


@contextmanager
def part_clock(refiner: Refiner) -> Iterator[dict[str, float]]:
    """Seconds spent within the modules of each part while the context is open."""
    seconds = dict.fromkeys(PART_OF.values(), 0.0)
    starts: list[float] = []
    handles = []

    def leave(name: str) -> Callable[..., None]:
        def hook(*_: object) -> None:
            seconds[name] += now() - starts.pop()

        return hook

    for module in refiner.modules():
        name = PART_OF.get(type(module))
        if name:
            handles.append(module.register_forward_pre_hook(lambda *_: starts.append(now())))
            handles.append(module.register_forward_hook(leave(name)))
    try:
        yield seconds
    finally:
        for handle in handles:
            handle.remove()


@torch.no_grad()
def matrix_work(refiner: Refiner, scene: Gaussians, structure: Structure) -> tuple[int, float, dict[str, float]]:
    """Operations of one inference in matrix products and attention, the seconds within their kernels, and the
    seconds of each part.

    A multiply-add counts as two; the exponentials of attention count as nothing, though their time counts.
    """
    from torch.profiler import ProfilerActivity, profile
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        refiner(scene, structure)
    on_gpu = scene.device.type == "cuda"
    kinds = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]
    with profile(activities=kinds) as profiler, part_clock(refiner) as seconds:
        start = now()
        refiner(scene, structure)
        seconds["rest"] = now() - start - sum(seconds.values())
    micro = 0.0
    for event in profiler.key_averages():
        if event.key in MATRIX_KERNELS or event.key.startswith("aten::_scaled_dot_product"):
            micro += event.device_time_total if on_gpu else event.cpu_time_total
    return counter.get_total_flops(), 1e-6 * micro, seconds


def training_step(refiner: Refiner, scene: Gaussians, structure: Structure) -> None:
    """Forward and backward of a sum over all refined parameters."""
    refiner.zero_grad(set_to_none=True)
    sum(value.sum() for value in refiner(scene, structure).tensors()).backward()


@torch.no_grad()
def half_precision(refiner: Refiner, scene: Gaussians, structure: Structure, args: Args) -> dict[str, float]:
    """Seconds of an inference under bfloat16 autocast, and the relative error (RMS) of each attribute's residual."""

    def run() -> Gaussians:
        with torch.autocast(scene.device.type, torch.bfloat16):
            return refiner(scene, structure)

    figures = {"seconds": measured(run, args.repeats, args.budget, scene.device)[0]}
    exact, rounded = refiner(scene, structure), run()
    for (name, a), b, before in zip(exact.items(), rounded.tensors(), scene.tensors(), strict=True):
        figures[name] = float((a - b).norm() / (a - before).norm().clamp_min(1e-20))
    return figures


def run_case(size: str, count: int, train: bool, args: Args) -> Result:
    """Everything that is measured of one size at one count."""
    device = torch.device(args.device)
    scene, refiner = room_gaussians(count, device), awake(size, device)
    structure = refiner.prepare(scene)

    @torch.no_grad()
    def infer() -> None:
        refiner(scene, structure)

    limits = args.repeats, args.budget, device
    rate = matrix_rate(device)
    inference, inference_bytes = measured(infer, *limits)
    prepare, _ = measured(lambda: refiner.prepare(scene), *limits)
    flops, matrix_seconds, seconds = matrix_work(refiner, scene, structure)
    seconds["structure"] = prepare
    shares = {name: seconds[name] / sum(seconds.values()) for name in PARTS}
    result = Result(size, count, prepare, inference, flops, rate, shares, matrix_seconds, inference_bytes)
    if train:
        refiner.train()
        result.step, result.step_bytes = measured(lambda: training_step(refiner, scene, structure), *limits)
        refiner.eval()
    if args.bf16:
        result.bf16 = half_precision(refiner, scene, structure, args)
    return result


def plan(args: Args) -> list[tuple[str, int, bool]]:
    """Size, count and whether to train, of every case.

    Raises:
        PointSplatError: if a size is unknown or a count is not positive.
    """
    unknown = [size for size in args.sizes if size not in PRESETS]
    if unknown or not args.sizes:
        raise PointSplatError(f"no refiner size {', '.join(unknown)!r}; expected some of {', '.join(PRESETS)}")
    if args.counts is not None and (not args.counts or min(args.counts) < 1):
        raise PointSplatError(f"counts are {args.counts}; expected numbers of Gaussians from 1 on")
    cases = []
    for size in args.sizes:
        counts = args.counts or (COUNTS if args.full else PLAN[size])
        cases += [(size, n, args.full or args.counts is not None or n <= TRAIN_UP_TO[size]) for n in counts]
    return cases


def print_tables(results: list[Result], args: Args) -> None:
    """Figures by case, then the slopes by size."""
    rate = max(r.rate for r in results)
    console.print(
        f"torch {torch.__version__} on {args.device}, threads: {torch.get_num_threads()}; "
        f"plain matrix products reach {rate / 1e9:.0f} GFLOP/s."
    )
    table = Table(title="Refiner: time, memory and work")
    columns = ("size", "Gaussians", "structure s", "inference s", "memory", "step s", "step memory", "GFLOP")
    for name in (*columns, "of matrix rate", "overall", *PARTS):
        table.add_column(name, justify="left" if name == "size" else "right")
    for r in results:
        figures = [f"{r.prepare:.3f}", f"{r.inference:.3f}", _megabytes(r.inference_bytes)]
        figures += ["-" if r.step is None else f"{r.step:.3f}", _megabytes(r.step_bytes), f"{r.flops / 1e9:.1f}"]
        figures += [f"{r.efficiency:.0%}", f"{r.flops / (r.rate * r.inference):.0%}"]
        table.add_row(r.size, f"{r.gaussians:,}", *figures, *(f"{r.shares[name]:.0%}" for name in PARTS))
    console.print(table)

    slopes = Table(title="Slopes of log time over log N (1: linear)")
    for name in ("size", "from", "inference", "training step", "structure"):
        slopes.add_column(name)
    for size in dict.fromkeys(r.size for r in results):
        for least in (min(r.gaussians for r in results if r.size == size), SLOPE_FROM):
            rows = [r for r in results if r.size == size and r.gaussians >= least]
            trained = [r for r in rows if r.step is not None]
            counts = [r.gaussians for r in rows]
            values = (
                slope(counts, [r.inference for r in rows]),
                slope([r.gaussians for r in trained], [r.step for r in trained]),
                slope(counts, [r.prepare for r in rows]),
            )
            slopes.add_row(size, f"{least:,}", *("-" if value is None else f"{value:.2f}" for value in values))
    console.print(slopes)

    if any(r.bf16 for r in results):
        half = Table("size", "Gaussians", "speed against float32", title="bfloat16 autocast, error of residuals (RMS)")
        names = [name for name in results[0].bf16 if name != "seconds"]
        for name in names:
            half.add_column(name, justify="right")
        for r in results:
            errors = (f"{r.bf16[name]:.1%}" for name in names)
            half.add_row(r.size, f"{r.gaussians:,}", f"{r.inference / r.bf16['seconds']:.2f}", *errors)
        console.print(half)


def _megabytes(value: int | None) -> str:
    return "-" if value is None else f"{value / 1e6:,.0f} MB"


def plot(results: list[Result], path: Path) -> None:
    """Seconds and peak memory against the number of Gaussians, log-log: inference solid, training step dashed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    for i, size in enumerate(dict.fromkeys(r.size for r in results)):
        rows = sorted((r for r in results if r.size == size), key=lambda r: r.gaussians)
        lines = [("inference", "o-", "inference", "inference_bytes"), ("training step", "s--", "step", "step_bytes")]
        for label, style, seconds, held in lines:
            for axes, name, unit in ((left, seconds, 1.0), (right, held, 1e9)):
                points = [(r.gaussians, getattr(r, name) / unit) for r in rows if getattr(r, name)]
                if points:
                    axes.plot(*zip(*points, strict=True), style, color=f"C{i}", label=f"{size}, {label}")
    left.set(xscale="log", yscale="log", xlabel="Gaussians", ylabel="seconds")
    right.set(xscale="log", yscale="log", xlabel="Gaussians", ylabel="peak extra memory, GB")
    for axes in (left, right):
        axes.grid(True, which="both", alpha=0.3)
    left.legend(fontsize=8)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
    console.print(f"wrote {path}")


def main(args: Args) -> None:
    """Run the cases and print the tables."""
    if args.threads:
        torch.set_num_threads(args.threads)
    cases = plan(args)
    results: list[Result] = []
    for i, (size, count, train) in enumerate(cases, 1):
        with console.status(f"case {i} of {len(cases)}: {size}, {count:,} Gaussians"):
            results.append(run_case(size, count, train, args))
        r = results[-1]
        console.print(f"{i}/{len(cases)} {size}, {count:,} Gaussians: {r.inference:.3f} s")
        write_json(args, {}, [{**vars(r), "efficiency": r.efficiency} for r in results])
    print_tables(results, args)
    if args.plot:
        plot(results, args.plot)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except PointSplatError as error:
        sys.exit(str(error))
