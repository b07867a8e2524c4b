"""Time, memory and errors of the rasterizer, stage by stage, all in one run.

    python -m lab.speed.rasterizer                                # synthetic room; a few minutes
    python -m lab.speed.rasterizer --scenes outputs/kitchen/...   # and a trained scene, dense and pruned to a tenth
    python -m lab.speed.rasterizer --variants eager compiled balanced fast --json out.json

Machines differ and are shared: compare figures of one run, by their ratios. On a busy machine `--cpu-time` counts the
CPU seconds of one thread. gsplat on a GPU is measured by cuda.py.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lab.common.printing import console, megabytes, number, start, table
from lab.common.results import grouped, write_json
from lab.common.scenes import Scene, room_scene, trained_scenes
from lab.common.timing import now, peak_extra_bytes, slope, timed, use_cpu_time
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import psnr
from pointsplat_ns.rasterizer import binning, rasterization
from pointsplat_ns.rasterizer.blending import blend
from pointsplat_ns.rasterizer.colors import sh_to_color
from pointsplat_ns.rasterizer.pixel_walk import sum_over_pixels
from pointsplat_ns.rasterizer.projection import Projected, project
from pointsplat_ns.rasterizer.tiles import Footprints
from pointsplat_ns.system.threads import one_thread

VARIANTS: dict[str, dict[str, Any]] = {
    "eager": {"compiled": False},
    "compiled": {"compiled": True},
    "balanced": {"quality": "balanced"},
    "fast": {"quality": "fast"},
}
"""What is timed, by name: options of ``rasterization``. Errors are against the image of "eager"."""

STAGES = ("projection", "colours", "binning", "blending", "blending backward", "projection backward")
SIZES = ((160, 120), (640, 480), (1200, 680))
COUNTS = (10_000, 60_000, 200_000, 300_000, 1_000_000)
MAIN_SIZE, MAIN_COUNT = (640, 480), 200_000


@dataclass
class Args:
    """Time the rasterizer."""

    scenes: tuple[Path, ...] = ()
    """Trained scenes: Splatfacto runs (folder or config.yml), seen from a held-out camera, or PLY files."""
    view: int | None = None
    """Which camera of a trained scene; its middle one by default."""
    gaussians: tuple[int, ...] | None = None
    """Sizes of the synthetic room; with --sizes, every combination is run. None of them: pass 0."""
    sizes: tuple[str, ...] | None = None
    """Image sizes such as 640x480, for every scene."""
    variants: tuple[str, ...] = ("eager",)
    """Which variants to time: eager, compiled, balanced, fast; the first is the base of all ratios."""
    repeats: int = 5
    """Rounds; medians are reported."""
    fastest: bool = False
    """Report the fastest round of each figure in place of the median: for a machine that is busy with other things."""
    budget: float = 8.0
    """Seconds a case may take before it is content with fewer rounds."""
    cpu_time: bool = False
    """Count CPU seconds of one thread in place of wall time: steadier still on a busy machine. Sets --threads 1."""
    threads: int | None = None
    """Threads of torch; its own choice by default."""
    device: str = "cpu"
    """Where our own code runs."""
    json: Path | None = None
    """Write all figures here, after each case."""


@dataclass
class Result:
    """What was measured of one case: seconds and errors by name, bytes."""

    scene: str
    family: str
    width: int
    height: int
    gaussians: int
    visible: int
    pairs: int
    """Pairs of a Gaussian and a pixel on which it is drawn."""
    seconds: dict[str, float]
    memory: dict[str, int | None]
    errors: dict[str, float] = field(default_factory=dict)

    def both(self, name: str) -> float | None:
        """Seconds of forward and backward together, of a variant."""
        ahead, back = self.seconds.get(f"{name} forward"), self.seconds.get(f"{name} backward")
        return ahead + back if ahead is not None and back is not None else None


class Case:
    """One scene at one image size."""

    def __init__(self, scene: Scene, width: int, height: int, device: torch.device):
        self.scene, self.width, self.height, self.device = scene, width, height, device
        self.tensors = [t.to(device).requires_grad_() for t in scene.tensors]
        self.viewmat, self.K = scene.viewmat.to(device), scene.K(width, height).to(device)
        g = torch.Generator().manual_seed(1)
        self.grad_image = torch.randn(height, width, 3, generator=g).to(device)
        self.grad_alphas = torch.randn(height, width, 1, generator=g).to(device)

    def draw(self, variant: str) -> tuple[Tensor, Tensor]:
        """An image (H, W, 3) and alphas (H, W, 1)."""
        camera = self.viewmat[None], self.K[None], self.width, self.height
        image, alphas, _ = rasterization(*self.tensors, *camera, sh_degree=3, **VARIANTS[variant])
        return image[0], alphas[0]

    def gradients(self, image: Tensor, alphas: Tensor) -> list[Tensor]:
        return list(torch.autograd.grad((image, alphas), self.tensors, (self.grad_image, self.grad_alphas)))

    def time_variant(self, name: str) -> dict[str, float]:
        marks = [now()]
        with torch.no_grad():
            self.draw(name)
        marks.append(now())
        drawn = self.draw(name)
        marks.append(now())
        self.gradients(*drawn)
        marks.append(now())
        names = ("inference", "forward", "backward")
        return {f"{name} {what}": b - a for what, (a, b) in zip(names, itertools.pairwise(marks), strict=True)}

    def footprints_of(self, seen: Projected) -> Footprints:
        geometry = [t.detach() for t in (seen.means2d, seen.cov2d, seen.det, seen.opacities)]
        camera, engine = torch.zeros_like(seen.ids), binning.engine_of(None, *geometry)
        return Footprints(*geometry, seen.depth_keys, camera, 1, self.width, self.height, engine=engine)

    def time_stages(self) -> dict[str, float]:
        """Stage by stage, forward as in training and backward: what `rasterization` does for one camera, compiled
        where it is so by default.

        Blending makes the lists of tiles itself; that part is timed once more on its own, and counted as binning.
        """
        marks = [now()]
        seen = project(*self.tensors[:4], self.viewmat, self.K, self.width, self.height)
        marks.append(now())
        colors = sh_to_color(seen.directions, self.tensors[4], 3, seen.ids)
        marks.append(now())
        inputs = [seen.means2d, seen.cov2d, seen.det, seen.opacities, colors]
        leaves = [t.detach().requires_grad_() for t in inputs]
        footprints = self.footprints_of(seen)
        marks.append(now())
        drawn = blend(*leaves, footprints)
        marks.append(now())
        grads = torch.autograd.grad(drawn, leaves, (self.grad_image[None], -self.grad_alphas[None]))
        marks.append(now())
        torch.autograd.grad(inputs, self.tensors, grads)
        marks.append(now())
        spans = dict(zip(STAGES, (b - a for a, b in itertools.pairwise(marks)), strict=True))
        footprints.tiles(footprints.whole)
        lists = now() - marks[-1]
        spans["binning"] += lists
        spans["blending"] = max(0.0, spans["blending"] - lists)
        return {f"stage {name}": span for name, span in spans.items()}

    def time_exponential(self) -> dict[str, float]:
        """One exponential, in numbers that stay in the cache, on one thread."""
        numbers, calls = torch.full((2**12,), -1.0, device=self.device), 200
        with one_thread():
            start = now()
            for _ in range(calls):
                torch.exp2(numbers)
            return {"exponential": (now() - start) / (calls * len(numbers))}

    @torch.no_grad()
    def drawn(self) -> tuple[int, int]:
        """Gaussians that are drawn, and pairs of them and a pixel."""
        seen = project(*self.tensors[:4], self.viewmat, self.K, self.width, self.height)
        counts = sum_over_pixels(
            seen, self.width, self.height, 1, lambda block: (block.alpha > 0).sum(-1, keepdim=True).to(block.alpha)
        )
        return int((counts > 0).sum()), int(counts.double().sum())


def run_case(case: Case, args: Args) -> Result:
    """Everything that is measured of one case."""
    base, errors = args.variants[0], {}
    with torch.no_grad():
        exact = case.draw("eager")[0].clamp(0, 1)
        for name in args.variants:
            image = case.draw(name)[0].clamp(0, 1)
            errors |= {f"{name} max": float((image - exact).abs().max()), f"{name} PSNR": float(psnr(image, exact))}
    functions: dict[str, Callable[[], dict[str, float]]] = {
        name: partial(case.time_variant, name) for name in args.variants
    }
    functions["stages"] = case.time_stages
    functions["exponential"] = case.time_exponential
    seconds = timed(functions, args.repeats, args.budget, args.fastest)

    def forward() -> None:
        with torch.no_grad():
            case.draw(base)

    memory = {
        "inference": peak_extra_bytes(forward, case.device),
        "training": peak_extra_bytes(lambda: case.gradients(*case.draw(base)), case.device),
    }
    scene, size = case.scene, (case.width, case.height)
    return Result(scene.name, scene.family, *size, len(scene), *case.drawn(), seconds, memory, errors)


def plan(args: Args) -> list[tuple[Scene, tuple[int, int]]]:
    """The cases: those asked for, or a choice that shows every trend in a few minutes."""
    chosen = [_size_of(text) for text in args.sizes] if args.sizes else None
    cases = []
    for count in COUNTS if args.gaussians is None else filter(None, args.gaussians):
        few = chosen is None and args.gaussians is None and count != MAIN_COUNT
        cases += [(room_scene(count), size) for size in ((MAIN_SIZE,) if few else chosen or SIZES)]
    for path in args.scenes:
        cases += [(scene, size) for scene in trained_scenes(path, args.view) for size in chosen or SIZES]
    return cases


def _size_of(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise PointSplatError(f"size is {text!r}; expected WIDTHxHEIGHT such as 640x480")
    return int(parts[0]), int(parts[1])


def print_tables(results: list[Result], variants: tuple[str, ...]) -> None:
    """Everything that was measured; the first variant is what ratios refer to."""
    base, ms, ratio = variants[0], number(1, 1e3), number(2)
    timed_names = [*dict.fromkeys(name for r in results for name in r.seconds)]

    def show(title: str, columns: dict[str, Callable[[Result], str]]) -> None:
        rows = [[r.scene, f"{r.width}x{r.height}", *(value(r) for value in columns.values())] for r in results]
        console().print(table(title, ["case", "size", *columns], rows))

    def over(a: float | None, b: float | None) -> str:
        return ratio(a / b if a and b else None)

    def error(name: str, value: float | None) -> str:
        return "-" if value is None else f"{value:{'.1f' if name.endswith('PSNR') else '.1e'}}"

    times = {
        name.removeprefix("stage "): lambda r, n=name: ms(r.seconds.get(n))
        for name in timed_names
        if name != "exponential"
    }

    def exponentials(result: Result, *stages: str) -> str:
        """Time of stages over that of one exponential for each pair."""
        taken = sum(result.seconds[f"stage {stage}"] for stage in stages)
        return over(taken, result.pairs * result.seconds["exponential"])

    show("Milliseconds", {"visible": lambda r: f"{r.visible:,}", **times})
    show(
        "Time of blending over that of one exponential for each pair of a Gaussian and a pixel on which it is drawn",
        {
            "pairs, millions": lambda r: f"{r.pairs / 1e6:.1f}",
            "blending": lambda r: exponentials(r, "blending"),
            "and backward": lambda r: exponentials(r, "blending", "blending backward"),
        },
    )
    show(
        f"Seconds of forward and backward in those of {base} (above 1: slower); {base}'s peak memory, MB",
        {
            **{name: lambda r, n=name: over(r.both(n), r.both(base)) for name in variants[1:]},
            **{f"memory, {name}": lambda r, n=name: megabytes(r.memory[n]) for name in results[0].memory},
        },
    )
    show(
        "Errors against the exact image (colour units, dB)",
        {name: lambda r, n=name: error(n, r.errors.get(n)) for name in results[0].errors},
    )
    lines = []
    for name, rows in grouped(results, lambda r: r.scene).items():  # type: ignore[arg-type, return-value]
        found = slope([r.width * r.height for r in rows], [r.both(base) for r in rows])
        if found is not None:
            lines.append([name, len(rows), ratio(found)])
    console().print(
        table(f"Slopes of log time of {base} over pixels, both ways (1: linear)", ["", "cases", "slope"], lines)
    )


def main(args: Args) -> None:
    """Run the cases and print the tables."""
    unknown = [name for name in args.variants if name not in VARIANTS]
    if unknown or not args.variants:
        raise PointSplatError(f"no variant is called {', '.join(unknown)!r}; expected some of {', '.join(VARIANTS)}")
    if args.cpu_time:
        args.threads = 1
        use_cpu_time()
    if args.threads:
        torch.set_num_threads(args.threads)
    cases = plan(args)
    if not cases:
        raise PointSplatError("nothing to draw; expected a count in --gaussians or a scene in --scenes")
    clock = "CPU" if args.cpu_time else "wall"
    print(f"torch {torch.__version__} on {args.device}, {torch.get_num_threads()} threads, {clock} time")
    results: list[Result] = []
    for i, (scene, (width, height)) in enumerate(cases, 1):
        results.append(run_case(Case(scene, width, height, torch.device(args.device)), args))
        settings = {"torch": torch.__version__, "threads": torch.get_num_threads(), "clock": clock}
        write_json(args.json, settings | {"cases": [vars(result) for result in results]})
        taken = number(1, 1e3)(results[-1].both(args.variants[0]))
        print(f"{i}/{len(cases)} {scene.name} at {width}x{height}: {taken} ms, both ways", flush=True)
    print_tables(results, args.variants)


if __name__ == "__main__":
    start(main)
