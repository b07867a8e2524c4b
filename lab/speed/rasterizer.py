"""Time and errors of the rasterizer in a synthetic room, all in one run.

    python -m lab.speed.rasterizer
    python -m lab.speed.rasterizer --variants eager compiled balanced fast --sizes 640x480 --json
    out.json

Machines differ and are shared: compare figures of one run, by their ratios. On a busy machine
`--cpu-time` counts the CPU seconds of one thread. gsplat on a GPU is measured by cuda.py.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lab.common.printing import console, number, start, table
from lab.common.results import Row, write_json
from lab.common.scenes import room
from lab.common.timing import now, timed, use_cpu_time
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import psnr
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.rendering.blending import blend
from pointsplat_ns.rendering.pixel_walk import sum_over_pixels
from pointsplat_ns.rendering.projection import camera_of, project
from pointsplat_ns.rendering.spherical_harmonics import sh_to_color
from pointsplat_ns.rendering.tiles import Footprints
from pointsplat_ns.system.threads import one_thread

VARIANTS: dict[str, dict[str, Any]] = {
    "eager": {"compiled": False},
    "compiled": {"compiled": True},
    "balanced": {"quality": "balanced"},
    "fast": {"quality": "fast"},
}
"""What is timed, by name: options of ``rasterization``. Errors are against the image of "eager"."""

FOCAL = 0.6
"""Focal length in image widths."""


class Case:
    """A synthetic room, seen from within towards one wall, at one image size."""

    def __init__(self, count: int, width: int, height: int):
        scene = room(count)
        self.tensors = [
            t.requires_grad_()
            for t in (scene.means, scene.quats, scene.stds, scene.alphas, scene.sh)
        ]
        self.width = width
        self.height = height
        self.viewmat = torch.eye(4)
        self.viewmat[2, 3] = 2.0
        focal = FOCAL * width
        self.K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        g = torch.Generator().manual_seed(1)
        self.grads = (
            torch.randn(height, width, 3, generator=g),
            torch.randn(height, width, 1, generator=g),
        )

    def draw(self, variant: str) -> tuple[Tensor, Tensor]:
        """An image (H, W, 3) and alphas (H, W, 1)."""
        camera = self.viewmat[None], self.K[None], self.width, self.height
        image, alphas, _ = rasterization(*self.tensors, *camera, sh_degree=3, **VARIANTS[variant])
        return image[0], alphas[0]

    def time_variant(self, name: str) -> dict[str, float]:
        """Seconds of a picture alone, of one that is to be differentiated, and of its gradients."""
        marks = [now()]
        with torch.no_grad():
            self.draw(name)
        marks.append(now())
        drawn = self.draw(name)
        marks.append(now())
        torch.autograd.grad(drawn, self.tensors, self.grads)
        marks.append(now())
        return _spans(marks, [f"{name} {what}" for what in ("inference", "forward", "backward")])

    def time_blending(self) -> dict[str, float]:
        """Seconds of blending both ways as in training, compiled where it is so by default, without
        the lists of tiles, and of one exponential in numbers that stay in the cache, on one
        thread."""
        seen = project(*self.tensors[:4], camera_of(self.viewmat, self.K, self.width, self.height))
        colors = sh_to_color(
            seen.directions, self.tensors[4][:, 0], self.tensors[4][:, 1:], 3, seen.ids
        )
        leaves = [
            t.detach().requires_grad_()
            for t in (seen.means2d, seen.cov2d, seen.det, seen.opacities, colors)
        ]
        seen = replace(
            seen, **dict(zip(("means2d", "cov2d", "det", "opacities"), leaves, strict=False))
        )
        footprints = Footprints(seen, self.width, self.height)
        marks = [now()]
        drawn = blend(seen, leaves[4], footprints)
        marks.append(now())
        torch.autograd.grad(drawn, leaves, (self.grads[0], -self.grads[1]))
        marks.append(now())
        footprints.tiles()
        marks.append(now())
        numbers = torch.full((2**12,), -1.0)
        calls = 200
        with one_thread():
            for _ in range(calls):
                torch.exp2(numbers)
        marks.append(now())
        found = _spans(marks, ["blending", "blending backward", "lists of tiles", "exponential"])
        found["blending"] = max(0.0, found["blending"] - found["lists of tiles"])
        found["exponential"] /= calls * len(numbers)
        return found

    @torch.no_grad()
    def drawn(self) -> tuple[int, int]:
        """Gaussians that are drawn, and pairs of them and a pixel."""
        seen = project(*self.tensors[:4], camera_of(self.viewmat, self.K, self.width, self.height))
        counts = sum_over_pixels(
            seen,
            self.width,
            self.height,
            1,
            lambda block: (block.alpha > 0).sum(-1, keepdim=True).to(block.alpha),
        )
        return int((counts > 0).sum()), int(counts.double().sum())


def _spans(marks: list[float], names: list[str]) -> dict[str, float]:
    return {name: b - a for name, a, b in zip(names, marks, marks[1:], strict=False)}


def measured(case: Case, variants: tuple[str, ...], repeats: int, budget: float) -> Row:
    """Seconds, errors and counts of one case."""
    errors = {}
    with torch.no_grad():
        exact = case.draw("eager")[0].clamp(0, 1)
        for name in variants:
            image = case.draw(name)[0].clamp(0, 1)
            errors |= {
                f"{name} max": float((image - exact).abs().max()),
                f"{name} PSNR": float(psnr(image, exact)),
            }
    functions = {name: partial(case.time_variant, name) for name in variants} | {
        "blending": case.time_blending
    }
    seconds = timed(functions, repeats, budget)
    visible, pairs = case.drawn()
    row: Row = {"gaussians": len(case.tensors[0]), "width": case.width, "height": case.height}
    return row | {"visible": visible, "pairs": pairs, "seconds": seconds, "errors": errors}


def show(rows: list[Row], variants: tuple[str, ...]) -> None:
    """Print milliseconds, ratios and errors; the first variant is what ratios refer to."""
    ms = number(1, 1e3)
    ratio = number(2)

    def both(row: Row, name: str) -> float:
        return row["seconds"][f"{name} forward"] + row["seconds"][f"{name} backward"]

    heads = ["Gaussians", "visible", "size"]
    lines = []
    timed_names = [name for name in rows[0]["seconds"] if name != "exponential"]
    for row in rows:
        line = [f"{row['gaussians']:,}", f"{row['visible']:,}", f"{row['width']}x{row['height']}"]
        lines.append([*line, *(ms(row["seconds"][name]) for name in timed_names)])
    console().print(table("Milliseconds", [*heads, *timed_names], lines))
    of_pairs = ["pairs, millions", "blending / exponentials", "both ways / exponentials"]
    ratios = [f"{name} / {variants[0]}" for name in variants[1:]]
    errors = list(rows[0]["errors"])
    for line, row in zip(lines, rows, strict=True):
        least = row["pairs"] * row["seconds"]["exponential"]
        blending = (
            row["seconds"]["blending"],
            row["seconds"]["blending"] + row["seconds"]["blending backward"],
        )
        line[3:] = [f"{row['pairs'] / 1e6:.1f}", *(ratio(span / least) for span in blending)]
        line += [ratio(both(row, name) / both(row, variants[0])) for name in variants[1:]]
        line += [
            f"{row['errors'][name]:{'.1f' if name.endswith('PSNR') else '.1e'}}" for name in errors
        ]
    title = (
        "Blending over one exponential for each pair of a Gaussian and a pixel on which it is "
        "drawn; forward and "
    )
    title += (
        "backward over those of the first variant; errors against the exact image (colour units, "
        "dB)"
    )
    console().print(table(title, [*heads, *of_pairs, *ratios, *errors], lines))


def _size_of(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise PointSplatError(f"size is {text!r}; expected WIDTHxHEIGHT such as 640x480")
    return int(parts[0]), int(parts[1])


def main(
    gaussians: tuple[int, ...] = (200_000,),
    sizes: tuple[str, ...] = ("160x120", "640x480", "1200x680"),
    variants: tuple[str, ...] = ("compiled", "eager", "balanced", "fast"),
    repeats: int = 5,
    budget: float = 8.0,
    cpu_time: bool = False,
    json: Path | None = None,
) -> None:
    """Time the rasterizer.

    Args:
        gaussians: sizes of the room; every combination with --sizes is run.
        sizes: image sizes.
        variants: eager, compiled, balanced, fast; the first is the base of all ratios.
        repeats: rounds; medians are reported.
        budget: seconds a case may take before it is content with fewer rounds.
        cpu_time: count CPU seconds of one thread in place of wall time: steadier on a busy machine.
        json: write all figures here, after each case.
    """
    unknown = [name for name in variants if name not in VARIANTS]
    if unknown or not variants:
        raise PointSplatError(
            f"no variant is called {', '.join(unknown)!r}; expected some of {', '.join(VARIANTS)}"
        )
    if cpu_time:
        torch.set_num_threads(1)
        use_cpu_time()
    clock = "CPU" if cpu_time else "wall"
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads, {clock} time", flush=True)
    rows: list[Row] = []
    for count in gaussians:
        for width, height in map(_size_of, sizes):
            rows.append(measured(Case(count, width, height), variants, repeats, budget))
            settings = {
                "torch": torch.__version__,
                "threads": torch.get_num_threads(),
                "clock": clock,
            }
            write_json(json, settings | {"cases": rows})
    show(rows, variants)


if __name__ == "__main__":
    start(main)
