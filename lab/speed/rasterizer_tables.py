"""Tables, slopes and the picture of the rasterizer's benchmark."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

console = Console(width=None if Console().is_terminal else 200)

STAGES = ("projection", "colours", "binning", "blending", "blending backward", "projection backward")


@dataclass
class Result:
    """What was measured of one case: seconds by name, counts, bytes."""

    scene: str
    family: str
    width: int
    height: int
    gaussians: int
    seconds: dict[str, float]
    pairs: dict[str, int]
    memory: dict[str, int | None]
    errors: dict[str, float] = field(default_factory=dict)

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def both(self, name: str) -> float | None:
        """Seconds of forward and backward together, of a variant or a peer."""
        ahead, back = self.seconds.get(f"{name} forward"), self.seconds.get(f"{name} backward")
        return ahead + back if ahead is not None and back is not None else None


def summary(result: Result, base: str) -> str:
    """One case in one line."""
    parts = [f"{result.scene} at {result.width}x{result.height}"]
    for name in (base, "C++", "C++ boxes", "C++ tight", "gsplat"):
        if result.both(name) is not None:
            ahead, back = result.seconds[f"{name} forward"], result.seconds[f"{name} backward"]
            parts.append(f"{name} {ahead:.3f} + {back:.3f} s")
    return ", ".join(parts)


def print_tables(
    results: Sequence[Result], variants: Sequence[str], floor: dict[str, float], device: torch.device, clock: str
) -> None:
    """Everything that was measured, on a "wall" or "CPU" clock; the first variant is what ratios refer to."""
    base = variants[0]
    threads = torch.get_num_threads()
    console.print(
        f"torch {torch.__version__} on {device}, threads: {threads} (C++ peer: 1), {clock} time. "
        f"Floor: {1e9 * floor['exp']:.3f} ns an exp, {1e9 * floor['fma']:.4f} ns a multiply-add."
    )
    stages = [("Gaussians", lambda r: f"{r.gaussians:,}"), ("visible", lambda r: f"{r.pairs['visible']:,}")]
    stages += [(name, _milliseconds(f"stage {name}")) for name in STAGES]
    stages += [(f"{base} {name}", _milliseconds(f"{base} {name}")) for name in ("inference", "forward", "backward")]
    _table("Time by stage, ms", results, stages)

    work = [
        ("tile pairs", lambda r: f"{r.pairs['tile_pairs'] / 1e6:.2f} M"),
        ("evaluated", lambda r: f"{r.pairs['evaluated'] / 1e6:.1f} M"),
        ("needed", lambda r: f"{r.pairs['needed'] / 1e6:.1f} M"),
        ("evaluated / needed", lambda r: _ratio(r.pairs["evaluated"], r.pairs["needed"])),
        ("needed a second, inference", lambda r: _rate(r, r.seconds[f"{base} inference"])),
        ("needed a second, both", lambda r: _rate(r, r.both(base))),
        ("memory, inference", lambda r: _megabytes(r.memory[f"{base} inference"])),
        ("memory, training", lambda r: _megabytes(r.memory[f"{base} training"])),
    ]
    _table("Work and peak memory", results, work)

    peers = []
    for variant in variants:
        peers += [
            (f"C++ / {variant}, forward", _speedup("C++ forward", f"{variant} forward")),
            (f"C++ / {variant}, backward", _speedup("C++ backward", f"{variant} backward")),
            (f"C++ / {variant}, both", lambda r, v=variant: _times(r.both("C++"), r.both(v))),
            (f"C++ boxes / {variant}, both", lambda r, v=variant: _times(r.both("C++ boxes"), r.both(v))),
            (f"C++ tight / {variant}, both", lambda r, v=variant: _times(r.both("C++ tight"), r.both(v))),
        ]
    peers += [
        (f"{base} / floor, forward", _speedup(f"{base} inference", "floor forward")),
        (f"{base} / floor, both", lambda r: _times(r.both(base), r.both("floor"))),
        (f"reference / {base}", _speedup("reference inference", f"{base} inference")),
        (f"{base} / gsplat, both", lambda r: _times(r.both(base), r.both("gsplat"))),
    ]
    _table("Ratios to peers (above 1: the first is slower)", results, peers)

    shared = ("projection", "binning", "projection backward")
    peer = [(f"C++ {name}", _milliseconds(f"C++ stage {name}")) for name in shared]
    for name in ("C++", "C++ boxes", "C++ tight"):
        peer += [(f"{name} {stage}", _milliseconds(f"{name} stage {stage}")) for stage in STAGES[3:5]]
        peer.append((f"{name} both", lambda r, n=name: "-" if r.both(n) is None else f"{1e3 * r.both(n):.1f}"))
    peer += [
        ("image, largest", lambda r: _error(r, "C++ image")),
        ("values off by 1e-4", lambda r: _error(r, "C++ flipped")),
        ("gradient, relative", lambda r: _error(r, "C++ gradient")),
        ("needed pairs, relative", lambda r: _error(r, "C++ needed")),
    ]
    _table(f"The C++ peer, ms, and how far {base} is from it", results, peer)

    if len(variants) > 1:
        rows = []
        for variant in variants:
            rows += [
                (f"{variant}, both ms", lambda r, v=variant: f"{1e3 * r.both(v):.1f}"),
                (f"{variant}, speed", lambda r, v=variant: _times(r.both(base), r.both(v))),
                (f"{variant}, error max", lambda r, v=variant: _error(r, f"{v} max")),
                (f"{variant}, error mean", lambda r, v=variant: _error(r, f"{v} mean")),
            ]
        _table("Variants: time against error (colour units, from the exact image)", results, rows)
    _print_slopes(results, base)


def slope(xs: Sequence[float], ys: Sequence[float]) -> float | None:
    """Least-squares slope of log y over log x; None where a value has no log or x does not even double."""
    if min((*xs, *ys), default=0) <= 0 or max(xs) < 2 * min(xs):
        return None
    u, v = [math.log(x) for x in xs], [math.log(y) for y in ys]
    mean_u, mean_v = sum(u) / len(u), sum(v) / len(v)
    covariance = sum((a - mean_u) * (b - mean_v) for a, b in zip(u, v, strict=True))
    return covariance / sum((a - mean_u) ** 2 for a in u)


def _print_slopes(results: Sequence[Result], base: str) -> None:
    """Against pixels: one scene at several sizes. Against pairs: that, and all cases of a family."""
    table = Table(title="Slopes of log time (1: linear)")
    for name in ("cases", "against", "n", f"{base} inference", f"{base} both", "blending", "blending backward"):
        table.add_column(name, justify="left" if name in ("cases", "against") else "right")
    groups: list[tuple[str, str, list[Result], Callable[[Result], float]]] = []
    for name in dict.fromkeys(r.scene for r in results):
        rows = [r for r in results if r.scene == name]
        groups.append((name, "pixels", rows, lambda r: r.pixels))
        groups.append((name, "needed pairs", rows, lambda r: r.pairs["needed"]))
    for name in dict.fromkeys(r.family for r in results if r.family != r.scene):
        groups.append((name, "needed pairs", [r for r in results if r.family == name], lambda r: r.pairs["needed"]))
    groups.append(("all", "needed pairs", list(results), lambda r: r.pairs["needed"]))
    for name, against, rows, x in groups:
        times = (
            [r.seconds[f"{base} inference"] for r in rows],
            [r.both(base) for r in rows],
            [r.seconds["stage blending"] for r in rows],
            [r.seconds["stage blending backward"] for r in rows],
        )
        slopes = [slope([x(r) for r in rows], t) for t in times]
        if slopes[0] is not None:
            table.add_row(name, against, str(len(rows)), *("-" if s is None else f"{s:.2f}" for s in slopes))
    if table.row_count:
        console.print(table)


def plot(results: Sequence[Result], base: str, path: Path) -> None:
    """Time of forward and backward against needed pairs, log-log, ours and the peers'."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 6))
    families = list(dict.fromkeys(r.family for r in results))
    styles = {
        base: ("o", True),
        "C++": ("x", True),
        "C++ boxes": ("+", True),
        "C++ tight": ("*", True),
        "gsplat": ("^", True),
        "floor": ("_", False),
    }
    for i, family in enumerate(families):
        for peer, (marker, in_families) in styles.items():
            points = [(r.pairs["needed"], r.both(peer)) for r in results if r.family == family and r.both(peer)]
            points = sorted(p for p in points if p[0] > 0)
            if not points:
                continue
            label = f"{family}: {peer}" if in_families else (peer if i == 0 else None)
            color = f"C{i}" if in_families else "black"
            axes.plot(*zip(*points, strict=True), marker=marker, linestyle="", label=label, color=color)
    axes.set(xscale="log", yscale="log", xlabel="needed Gaussian-pixel pairs", ylabel="forward + backward, s")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
    console.print(f"wrote {path}")


def _table(title: str, results: Sequence[Result], columns: list[tuple[str, Callable[[Result], str]]]) -> None:
    table = Table(title=title)
    table.add_column("case", no_wrap=True)
    table.add_column("size", no_wrap=True)
    for name, _ in columns:
        table.add_column(name, justify="right")
    for r in results:
        table.add_row(r.scene, f"{r.width}x{r.height}", *(value(r) for _, value in columns))
    console.print(table)


def _milliseconds(name: str) -> Callable[[Result], str]:
    return lambda r: f"{1e3 * r.seconds[name]:.1f}" if name in r.seconds else "-"


def _times(over: float | None, under: float | None) -> str:
    return "-" if over is None or not under else f"{over / under:.3g}"


def _speedup(over: str, under: str) -> Callable[[Result], str]:
    return lambda r: _times(r.seconds.get(over), r.seconds.get(under))


def _ratio(over: float, under: float) -> str:
    return f"{over / under:.1f}" if under else "-"


def _rate(result: Result, seconds: float | None) -> str:
    return f"{result.pairs['needed'] / seconds / 1e6:.0f} M" if seconds else "-"


def _megabytes(value: int | None) -> str:
    return "-" if value is None else f"{value / 1e6:.0f} MB"


def _error(result: Result, name: str) -> str:
    return f"{result.errors[name]:.1e}" if name in result.errors else "-"
