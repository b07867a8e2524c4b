"""Whether second-order steps repair a merged scene in less time than those of Adam and the learned ones.

    python benchmarks/second_order.py scenes/bouquet.ply outputs/room/splatfacto-cpu/RUN --keep 10%

Two ways, both without a matrix, of the squared error of all pixels:

- Gauss-Newton with a trust region (Levenberg-Marquardt): some views at once, some iterations of conjugate gradients,
  which see products with the Jacobian (a difference of two pictures) and with its transpose (a backward pass), and a
  search for the length of the step in other views.
- the diagonal alone, one view a step: averages of the gradient, divided by averages of the diagonal of ``J^T J``, which
  is the mean of ``(J^T u)^2`` over random signs ``u`` (Hutchinson): a second backward pass a step.

Judged in sampled views, or in the poses of held-out photos, against the dense scene's renders; no step sees these.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import torch
import tyro
from held_out import mean_psnr, name_of, photos_of
from torch import Tensor

import pointsplat_ns as ps
from pointsplat_ns.compression.optimiser import extent
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.repair import repair, share_of_rates
from pointsplat_ns.compression.requests import PruneRequest, RepairBudget
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.refiner.feedback import shipped_feedback_refiner
from pointsplat_ns.views import View

Parameters = dict[str, Tensor]

UNITS = {"scales": 0.1, "quats": 0.05, "opacities": 0.3, "features_dc": 0.1, "features_rest": 0.03}
"""A small change of each parameter; of the means it is a thousandth of the scene's extent."""

LOOK = 0.2
"""How far pictures are drawn on both sides for their change in a direction, units in the root mean square. Nearer, what
jumps counts too much (alphas below 1/255 are not drawn); farther, they bend."""

SIGNS = 3
"""Random signs of each view for the diagonal of a Gauss-Newton step: by one, some Gaussians seem not to be seen."""

FARTHEST = 10.0
"""Units that a Gauss-Newton step moves a parameter at most; that of the diagonal half of it."""


class Linear:
    """A scene's pictures in some views, and the products of vectors with their Jacobian."""

    def __init__(self, scene: Gaussians, views: list[View]):
        self.scene, self.views = scene, views
        self._leaves = {name: value.detach().requires_grad_() for name, value in scene.items() if value.numel()}
        with torch.enable_grad():
            drawn = scene.replace(**self._leaves)
            self._pictures = [ps.render(drawn, view) for view in views]
        self.pictures = [picture.detach() for picture in self._pictures]

    def back(self, pictures: list[Tensor]) -> Parameters:
        """``J^T u`` of pictures (H, W, 3)."""
        leaves = list(self._leaves.values())
        found = torch.autograd.grad(self._pictures, leaves, pictures, retain_graph=True, materialize_grads=True)
        return {name: value.nan_to_num(0.0, 0.0, 0.0) for name, value in zip(self._leaves, found, strict=True)}

    @torch.no_grad()
    def along(self, direction: Parameters, units: dict[str, float]) -> list[Tensor]:
        """``J v``, by the pictures of the scene moved a small way in this direction, and in the other."""
        count = sum(value.numel() for value in direction.values())
        mean = math.sqrt(sum(float((v / units[k]).square().sum()) for k, v in direction.items()) / count)
        step = LOOK / max(mean, 1e-30)
        ahead, behind = (_moved(self.scene, direction, sign * step) for sign in (1, -1))
        return [(ps.render(ahead, view) - ps.render(behind, view)) / (2 * step) for view in self.views]


def gauss_newton(
    scene: Gaussians, dense: Gaussians, source: ViewSource, seconds: float, at_once: int, iterations: int
) -> Iterator[tuple[float, Gaussians]]:
    """Levenberg-Marquardt steps until the CPU seconds are over; what each reached, and when."""
    start, views, generator = time.process_time(), source.others(), torch.Generator().manual_seed(0)
    units, damping, diagonal = {"means": extent(scene) * 1e-3, **UNITS}, 0.1, None
    while time.process_time() - start < seconds:
        linear = Linear(scene, list(itertools.islice(views, at_once)))
        with torch.no_grad():
            targets = [ps.render(dense, view) for view in linear.views]
        wrong = [picture - target for picture, target in zip(linear.pictures, targets, strict=True)]
        gradient, seen = linear.back(wrong), _diagonal(linear, generator, SIGNS)
        diagonal = seen if diagonal is None else {name: 0.5 * (diagonal[name] + seen[name]) for name in seen}
        step = _conjugate_gradients(linear, gradient, diagonal, damping, iterations, units)
        for name, value in step.items():
            value.clamp_(-FARTHEST * units[name], FARTHEST * units[name])
        share = _best_share(scene, step, dense, list(itertools.islice(views, max(2, at_once // 2))))
        scene = _moved(scene, step, share)
        damping *= 0.5 if share > 0.8 else 2.0 if share < 0.4 else 1.0
        yield time.process_time() - start, scene


def diagonal_newton(
    scene: Gaussians, dense: Gaussians, source: ViewSource, steps: int, rate: float, damping: float = 0.1
) -> Gaussians:
    """So many steps with the diagonal alone; ``rate`` is that of the first, as many Gaussians share a pixel."""
    generator, averages = torch.Generator().manual_seed(0), (0.8, 0.95)
    units = {"means": extent(scene) * 1e-3, **UNITS}
    first: Parameters = {}
    second: Parameters = {}
    for number, view in enumerate(itertools.islice(source.others(), steps)):
        linear = Linear(scene, [view])
        with torch.no_grad():
            wrong = linear.pictures[0] - ps.render(dense, view)
        gradient, seen, step = linear.back([wrong]), _diagonal(linear, generator, 1), {}
        for name, value in gradient.items():
            first[name] = first.get(name, torch.zeros_like(value)).lerp(value, 1 - averages[0])
            second[name] = second.get(name, torch.zeros_like(value)).lerp(seen[name], 1 - averages[1])
            whole = [1 - average ** (number + 1) for average in averages]
            curvature = second[name] / whole[1]
            newton = -first[name] / whole[0] / (curvature + damping * _mean_seen(curvature))
            step[name] = newton.clamp(-0.5 * FARTHEST * units[name], 0.5 * FARTHEST * units[name])
        scene = _moved(scene, step, rate * share_of_rates(number / steps))
    return scene


def _diagonal(linear: Linear, generator: torch.Generator, times: int) -> Parameters:
    """An estimate of the diagonal of ``J^T J``, each number averaged with those of its Gaussian."""
    squares: Parameters = {}
    for _ in range(times):
        signs = [torch.randint(0, 2, p.shape, generator=generator).to(p) * 2 - 1 for p in linear.pictures]
        for name, value in linear.back(signs).items():
            squares[name] = squares.get(name, 0.0) + value.square() / times
    return {
        name: 0.5 * (value + value.flatten(1).mean(1).view(-1, *[1] * (value.dim() - 1)))
        for name, value in squares.items()
    }


def _conjugate_gradients(
    linear: Linear,
    gradient: Parameters,
    diagonal: Parameters,
    damping: float,
    iterations: int,
    units: dict[str, float],
) -> Parameters:
    """An approximate solution of ``(J^T J + damping D) x = -gradient``, where D, the diagonal plus its mean, also
    scales: what hardly shows would be moved far beyond where pictures are linear."""
    scale = {name: (value + _mean_seen(value)).rsqrt() for name, value in diagonal.items()}
    left = {name: -scale[name] * value for name, value in gradient.items()}
    found = {name: torch.zeros_like(value) for name, value in left.items()}
    direction, size = left, _dot(left, left)
    for _ in range(iterations):
        unscaled = {name: scale[name] * value for name, value in direction.items()}
        product = linear.back(linear.along(unscaled, units))
        product = {name: scale[name] * value + damping * direction[name] for name, value in product.items()}
        curvature = _dot(direction, product)
        if not curvature > 0:
            break
        length = size / curvature
        found = {name: value + length * direction[name] for name, value in found.items()}
        left = {name: value - length * product[name] for name, value in left.items()}
        size, before = _dot(left, left), size
        direction = {name: value + size / before * direction[name] for name, value in left.items()}
    return {name: scale[name] * value for name, value in found.items()}


@torch.no_grad()
def _best_share(scene: Gaussians, step: Parameters, dense: Gaussians, views: list[View]) -> float:
    """The share of a step, in [0, 1.5], at which the parabola through three errors in other views is least."""
    targets = [ps.render(dense, view) for view in views]
    errors = []
    for share in (0.0, 0.5, 1.0):
        moved = _moved(scene, step, share)
        drawn = (ps.render(moved, view) - target for view, target in zip(views, targets, strict=True))
        errors.append(sum(float(wrong.double().square().mean()) for wrong in drawn))
    bend = errors[0] - 2 * errors[1] + errors[2]
    if bend <= 0:
        return 1.0 if errors[2] < errors[0] else 0.25
    return min(1.5, max(0.0, 0.5 + (errors[0] - errors[2]) / (4 * bend)))


def _moved(scene: Gaussians, step: Parameters, share: float) -> Gaussians:
    return scene.replace(**{name: getattr(scene, name).detach() + share * value for name, value in step.items()})


def _dot(a: Parameters, b: Parameters) -> float:
    return sum(float((a[name].double() * b[name].double()).sum()) for name in a)


def _mean_seen(diagonal: Tensor) -> float:
    """Mean of what is not 0; 1 if all is."""
    seen = diagonal[diagonal > 0]
    return float(seen.mean()) if seen.numel() else 1.0


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional],
    keep: str = "10%",
    seconds: float = 30.0,
    at_once: list[int] = [4, 8],  # noqa: B006 - never changed
    iterations: int = 6,
    rates: list[float] = [0.003, 0.01, 0.03],  # noqa: B006
    views: int = 12,
) -> None:
    """Repair merged scenes in each way.

    Args:
        scenes: .ply files and Splatfacto runs.
        keep: budget.
        seconds: of the processor, for each way of Gauss-Newton.
        at_once: views of each Gauss-Newton step.
        iterations: of conjugate gradients.
        rates: of the first step with the diagonal alone.
        views: that judge.
    """
    for path in scenes:
        dense = ps.load(path)
        judging = (
            ps.sample_views(dense, views, seed=1001) if path.suffix == ".ply" else photos_of(path, "test", views)[1]
        )
        with torch.no_grad():
            renders = [ps.render(dense, view) for view in judging]
        source = ViewSource(dense, run=path, dataset_views=dataset_views)
        merged = prune_scene(dense, PruneRequest(keep), source).scene
        source.compared()

        def show(what: str, took: float, scene: Gaussians, path=path, judging=judging, renders=renders) -> None:
            print(
                f"{name_of(path)} {keep} {what}: {mean_psnr(scene, judging, renders):.2f} dB, {took:.1f} s", flush=True
            )

        show("merged", 0.0, merged)
        for what, network in (("Adam", None), ("learned", shipped_feedback_refiner(dense.device))):
            started = time.process_time()
            repaired = repair(merged, dense, source, RepairBudget("quick"), network=network)
            show(f"{what}, {repaired.steps} steps", time.process_time() - started, repaired.scene)
        for rate in rates:
            started = time.process_time()
            scene = diagonal_newton(merged, dense, source, repaired.steps, rate)
            show(f"diagonal, rate {rate:g}, {repaired.steps} steps", time.process_time() - started, scene)
        for count in at_once:
            for number, (took, scene) in enumerate(gauss_newton(merged, dense, source, seconds, count, iterations)):
                show(f"Gauss-Newton, {count} views, step {number + 1}", took, scene)


if __name__ == "__main__":
    tyro.cli(main)
