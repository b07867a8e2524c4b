"""Time, memory and work of the rasterizer, stage by stage, beside its peers, all in one run.

    python benchmarks/rasterizer.py                                # synthetic room; a few minutes
    python benchmarks/rasterizer.py --scenes outputs/kitchen/...   # and a trained scene, dense and pruned to a tenth
    python benchmarks/rasterizer.py --full --json out.json --plot out.png

Machines differ and are shared: compare figures of one run, by their ratios. On a busy machine `--cpu-time` counts the
CPU seconds of one thread, ours and the C++ peer's.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from measure import BACKWARD_FMAS, FORWARD_FMAS, count_pairs, floor_costs, now, peak_extra_bytes, timed, use_cpu_time
from options import Options, write_json
from report import Result, console, plot, print_tables, summary
from scenes import Scene, room_scene, trained_scenes
from torch import Tensor
from yardstick import CLASSIC_EXTENT, EXACT_EXTENT, TIGHT_EXTENT, Yardstick, load_yardstick

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.rasterizer import binning, rasterization, rasterize_reference
from pointsplat_ns.rasterizer.blending import blend
from pointsplat_ns.rasterizer.colors import sh_to_color
from pointsplat_ns.rasterizer.projection import Projected, project
from pointsplat_ns.rasterizer.tiles import Footprints

Draw = Callable[[list[Tensor], Tensor, Tensor, int, int], tuple[Tensor, Tensor]]


def variant(**options: Any) -> Draw:
    """The package with options: draws an image (H, W, 3) and alphas (H, W, 1)."""

    def draw(scene: list[Tensor], viewmat: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        image, alphas, _ = rasterization(*scene, viewmat[None], K[None], width, height, sh_degree=3, **options)
        return image[0], alphas[0]

    return draw


VARIANTS: dict[str, Draw] = {
    "eager": variant(compiled=False),
    "compiled": variant(compiled=True),
    "balanced": variant(quality="balanced"),
    "fast": variant(quality="fast"),
}
"""What is timed, by name; the first is the one that the others' errors and all ratios refer to."""

PEERS = {"C++": (CLASSIC_EXTENT, False), "C++ boxes": (CLASSIC_EXTENT, True), "C++ tight": (TIGHT_EXTENT, True)}
"""The C++ peer per pixel, which is the classic design; turned inside out, which is faster; and that with tight boxes
(see yardstick.cpp): extent and whether by boxes."""
SIZES = ((160, 120), (640, 480), (1200, 680))
COUNTS = (10_000, 60_000, 200_000, 300_000, 1_000_000)
MAIN_SIZE, MAIN_COUNT, REFERENCE_COUNT = (640, 480), 200_000, 10_000
KEPT_HITS_MAX = 4 * 10**8
"""Needed pairs beyond which the C++ peer is left out: it keeps 8 bytes of each for its backward pass."""


@dataclass
class Args(Options):
    """Time the rasterizer beside a C++ peer, a measured floor, the plain reference and gsplat."""

    scenes: tuple[Path, ...] = ()
    """Trained scenes: Splatfacto runs (folder or config.yml), or PLY files together with --views."""
    views: Path | None = None
    """Cameras for PLY files: JSON with "viewmats" (4 x 4, world to camera, OpenCV) and "focal" in image widths."""
    view: int | None = None
    """Which camera of a trained scene; its middle one by default."""
    gaussians: tuple[int, ...] | None = None
    """Sizes of the synthetic room; with --sizes, every combination is run. None of them: pass 0."""
    sizes: tuple[str, ...] | None = None
    """Image sizes such as 640x480, for every scene."""
    variants: tuple[str, ...] = ("eager",)
    """Which variants to time: eager, compiled, balanced, fast; the first is the base of all ratios."""
    full: bool = False
    """Every count of the room at every size."""
    repeats: int = 5
    """Rounds; medians are reported."""
    fastest: bool = False
    """Report the fastest round of each figure in place of the median: for a machine that is busy with other things."""
    budget: float = 8.0
    """Seconds a case may take before it is content with fewer rounds."""
    cpu_time: bool = False
    """Count CPU seconds of one thread in place of wall time: steadier still on a busy machine. Sets --threads 1."""


class Case:
    """One scene at one image size."""

    def __init__(self, scene: Scene, width: int, height: int, device: torch.device):
        self.scene, self.width, self.height, self.device = scene, width, height, device
        self.tensors = [t.to(device).requires_grad_() for t in scene.tensors]
        self.viewmat, self.K = scene.viewmat.to(device), scene.K(width, height).to(device)
        g = torch.Generator().manual_seed(1)
        self.grad_image = torch.randn(height, width, 3, generator=g).to(device)
        self.grad_alphas = torch.randn(height, width, 1, generator=g).to(device)

    def draw(self, variant: Draw) -> tuple[Tensor, Tensor]:
        return variant(self.tensors, self.viewmat, self.K, self.width, self.height)

    def gradients(self, image: Tensor, alphas: Tensor) -> list[Tensor]:
        return list(torch.autograd.grad((image, alphas), self.tensors, (self.grad_image, self.grad_alphas)))

    def time_variant(self, name: str, variant: Draw) -> dict[str, float]:
        start = now()
        with torch.no_grad():
            self.draw(variant)
        inference = now() - start
        start = now()
        drawn = self.draw(variant)
        middle = now()
        self.gradients(*drawn)
        return {f"{name} inference": inference, f"{name} forward": middle - start, f"{name} backward": now() - middle}

    def count_pairs(self) -> dict[str, int]:
        seen = project(*(t.detach() for t in self.tensors[:4]), self.viewmat, self.K, self.width, self.height)
        footprints = self.footprints_of(seen)
        return count_pairs(seen, footprints.tiles(footprints.whole), self.width, self.height)

    def footprints_of(self, seen: Projected) -> Footprints:
        geometry = [t.detach() for t in (seen.means2d, seen.cov2d, seen.det, seen.opacities)]
        camera, engine = torch.zeros_like(seen.ids), binning.engine_of(None, *geometry)
        return Footprints(*geometry, seen.beyond, camera, 1, self.width, self.height, engine=engine)

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
        marks.append(now())
        footprints = self.footprints_of(seen)
        marks.append(now())
        drawn = blend(*leaves, footprints)
        marks.append(now())
        grads = torch.autograd.grad(drawn, leaves, (self.grad_image[None], -self.grad_alphas[None]))
        marks.append(now())
        torch.autograd.grad(inputs, self.tensors, grads)
        marks.append(now())
        footprints.tiles(footprints.whole)
        marks.append(now())
        names = (
            "projection",
            "colours",
            "",
            "binning",
            "blending",
            "blending backward",
            "projection backward",
            "lists",
        )
        spans = {n: after - before for n, (before, after) in zip(names, itertools.pairwise(marks), strict=True)}
        lists = spans.pop("lists")
        spans["binning"] += lists
        spans["blending"] = max(0.0, spans["blending"] - lists)
        return {f"stage {name}": span for name, span in spans.items() if name}

    def time_yardstick(self, name: str, peer: Yardstick) -> dict[str, float]:
        scene = [t.cpu() for t in self.scene.tensors]
        grads = self.grad_image.cpu(), -self.grad_alphas.cpu()
        start = now()
        peer.forward(scene, self.scene.viewmat, self.K.cpu(), self.width, self.height, keep=True)
        middle = now()
        peer.backward(*grads)
        end = now()
        stages = {f"{name} stage {stage}": seconds for stage, seconds in peer.seconds.items()}
        return {f"{name} forward": middle - start, f"{name} backward": end - middle, **stages}

    def time_gsplat(self) -> dict[str, float]:
        from gsplat import rasterization as gsplat_rasterization

        tensors = [t.detach().cuda().requires_grad_() for t in self.tensors]
        camera = self.viewmat.cuda()[None], self.K.cuda()[None]
        grads = self.grad_image.cuda()[None], self.grad_alphas.cuda()[None]
        start = now()
        image, alphas, _ = gsplat_rasterization(*tensors, *camera, self.width, self.height, sh_degree=3)
        middle = now()
        torch.autograd.grad((image, alphas), tensors, grads)
        return {"gsplat forward": middle - start, "gsplat backward": now() - middle}

    def time_reference(self) -> float:
        """Seconds of one image by the plain reference; its backward would keep every image-sized step."""
        start = now()
        with torch.no_grad():
            tensors = [t.cpu() for t in self.tensors]
            rasterize_reference(*tensors, self.viewmat.cpu(), self.K.cpu(), self.width, self.height, sh_degree=3)
        return now() - start

    def disagreement(self, variant: Draw, module: Any, needed: int) -> dict[str, float]:
        """How far a variant is from the C++ peer drawing without the cut at three standard deviations: the largest
        difference of the image, the share of values that differ, the largest relative difference of a gradient
        (norms); and how far our count of needed pairs is from what the peer drew."""
        peer = Yardstick(module, EXACT_EXTENT)
        scene = [t.cpu() for t in self.scene.tensors]
        image, _ = peer.forward(scene, self.scene.viewmat, self.K.cpu(), self.width, self.height, keep=True)
        theirs = peer.backward(self.grad_image.cpu(), -self.grad_alphas.cpu())
        drawn = self.draw(variant)
        ours = self.gradients(*drawn)
        pairs = zip(ours, theirs, strict=True)
        difference = (drawn[0].detach().cpu() - image).abs()
        return {
            "C++ image": float(difference.max()),
            "C++ flipped": float((difference > 1e-4).float().mean()),
            "C++ needed": abs(peer.counts["drawn"] / max(1, needed) - 1),
            "C++ gradient": max(float((a.cpu() - b).norm() / b.norm().clamp_min(1e-20)) for a, b in pairs),
        }


def usable_gsplat() -> bool:
    """Whether gsplat draws on this machine's GPU; its kernels may be compiled here, once."""
    if not torch.cuda.is_available():
        return False
    try:
        Case(room_scene(10), 16, 16, torch.device("cuda")).time_gsplat()
    except Exception as error:  # no package, no compiler, a kernel that does not fit the GPU
        console.print(f"no gsplat: {str(error).strip().splitlines()[0][:160] if str(error).strip() else type(error)}")
        return False
    return True


def run_case(case: Case, args: Args, floor: dict[str, float], module: Any, with_gsplat: bool) -> Result:
    """Everything that is measured of one case."""
    variants = {name: VARIANTS[name] for name in args.variants}
    base, draw_base = next(iter(variants.items()))
    with torch.no_grad():
        scene, size = [t.detach() for t in case.tensors], (case.width, case.height)
        exact = VARIANTS["eager"](scene, case.viewmat, case.K, *size)[0]
        pairs = case.count_pairs()
        errors = {}
        for name, variant in variants.items():
            difference = (case.draw(variant)[0] - exact).abs()
            errors |= {f"{name} max": float(difference.max()), f"{name} mean": float(difference.mean())}
    del exact

    functions: dict[str, Callable[[], dict[str, float]]] = {
        name: lambda name=name, variant=variant: case.time_variant(name, variant) for name, variant in variants.items()
    }
    functions["stages"] = case.time_stages
    with_peer = module is not None and pairs["needed"] <= KEPT_HITS_MAX
    if with_peer:
        for name, (extent, boxes) in PEERS.items():
            peer = Yardstick(module, extent, boxes)
            functions[name] = lambda name=name, peer=peer: case.time_yardstick(name, peer)
    if with_gsplat:
        functions["gsplat"] = case.time_gsplat
    seconds = timed(functions, args.repeats, args.budget, args.fastest)
    functions.clear()  # the peers let go of what they kept
    if with_peer:
        errors |= case.disagreement(draw_base, module, pairs["needed"])
    if len(case.scene) <= REFERENCE_COUNT and case.width * case.height <= SIZES[0][0] * SIZES[0][1]:
        seconds["reference inference"] = case.time_reference()
    once = pairs["needed"] * (floor["exp"] + FORWARD_FMAS * floor["fma"])
    seconds |= {"floor forward": once, "floor backward": pairs["needed"] * BACKWARD_FMAS * floor["fma"]}

    def forward() -> None:
        with torch.no_grad():
            case.draw(draw_base)

    memory = {
        f"{base} inference": peak_extra_bytes(forward, case.device),
        f"{base} training": peak_extra_bytes(lambda: case.gradients(*case.draw(draw_base)), case.device),
    }
    scene = case.scene
    return Result(scene.name, scene.family, *size, len(scene), seconds, pairs, memory, errors)


def plan(args: Args) -> list[tuple[Scene, tuple[int, int]]]:
    """The cases: all of them, those asked for, or a choice that shows every trend in a few minutes."""
    chosen = [_size_of(text) for text in args.sizes] if args.sizes else None
    every = args.full or chosen is not None or args.gaussians is not None
    cases = []
    for count in COUNTS if args.gaussians is None else filter(None, args.gaussians):
        sizes = chosen or SIZES
        if not every:
            smallest = SIZES[:1] if count == REFERENCE_COUNT else ()
            sizes = SIZES if count == MAIN_COUNT else (*smallest, MAIN_SIZE)
        scene = room_scene(count)
        cases += [(scene, size) for size in sizes]
    for path in args.scenes:
        for scene in trained_scenes(path, args.views, args.view):
            cases += [(scene, size) for size in chosen or SIZES]
    return cases


def _size_of(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise PointSplatError(f"size is {text!r}; expected WIDTHxHEIGHT such as 640x480")
    return int(parts[0]), int(parts[1])


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
    device = torch.device(args.device)
    cases = plan(args)
    if not cases:
        raise PointSplatError("nothing to draw; expected a count in --gaussians or a scene in --scenes")
    with console.status("compiling the C++ peer (once)"):
        module, reason = load_yardstick()
    if module is None:
        console.print(reason)
    elif args.cpu_time:
        module.use_cpu_time()
    with_gsplat = usable_gsplat()
    floor = floor_costs(device)
    results = []
    for i, (scene, (width, height)) in enumerate(cases, 1):
        with console.status(f"case {i} of {len(cases)}: {scene.name} at {width}x{height}"):
            results.append(run_case(Case(scene, width, height, device), args, floor, module, with_gsplat))
        settings = {"cpu_time": args.cpu_time, "fastest": args.fastest, "seconds_each": floor}
        write_json(args, settings, [vars(result) for result in results])
        console.print(f"{i}/{len(cases)} {summary(results[-1], args.variants[0])}")
    print_tables(results, args.variants, floor, device, "CPU" if args.cpu_time else "wall")
    if args.plot:
        plot(results, args.variants[0], args.plot)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except PointSplatError as error:
        sys.exit(str(error))
