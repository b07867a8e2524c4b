"""The errors of float32 that stability.py measures, each against float64."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import pointsplat_ns as ps
from lab.numerics.cases import HEIGHT, WIDTH, Case, Sweep
from lab.numerics.reference import rasterize_reference
from pointsplat_ns.geometry.neighbours import other_neighbours
from pointsplat_ns.pruning.merging import MERGING, merge
from pointsplat_ns.pruning.merging.pair_cost import pair_costs
from pointsplat_ns.pruning.merging.pairs import cheapest_pairs
from pointsplat_ns.pruning.merging.state import Participants, initial_state
from pointsplat_ns.pruning.paper import paper_score
from pointsplat_ns.pruning.view_scores import lightgaussian_score, pup_score
from pointsplat_ns.refinement import Refiner
from pointsplat_ns.refinement.refiner import gaussian_features
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.view_sampling.content import content_size

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")

LEAST_GRADIENT = 1e-3
"""A kind of parameter whose gradient is below this share of the largest kind's, as that of the
rotation of a ball, is judged by that share: there is nothing to be right about."""


@dataclass(frozen=True)
class Row:
    """One error."""

    part: str
    """rasterizer, scores, merge or refiner."""
    what: str
    quantity: str
    sweep: str
    value: float
    error: float
    """Relative, see :func:`measured`; Inf where what came out is not finite."""
    worst: str = ""
    """The kind of parameter that it is the error of."""
    doubt: float = 0.0
    """Error of the fast path in float64: two formulas that disagree in float64, so at least one of
    them is no truth."""


@dataclass(frozen=True)
class Picture:
    """What a rasterizer makes of a case."""

    pixels: Tensor  # [H, W, 5] colours, alpha, depth relative to the largest; float64
    grads: dict[str, Tensor]  # float64, by relative changes where these mean something
    scale: float  # of depths


def measured(sweep: Sweep, value: float, compiled: bool) -> Iterator[Row]:
    """All errors of a case.

    Images: largest difference of a pixel, relative to the largest value of its channel. Gradients:
    of a fixed random sum of the image, norm of the difference relative to the norm, of the worst
    kind of parameter. Scores: largest difference relative to their range. Costs of merging: the
    same, relative to each cost; pairs: share of those chosen that differ. Residuals of the refiner,
    and the gradients of its weights: as gradients.

    Args:
        sweep, value: which case.
        compiled: also with compiled kernels.
    """

    def row(
        part: str, what: str, quantity: str, error: float, worst: str = "", doubt: float = 0.0
    ) -> Row:
        return Row(part, what, quantity, sweep.name, value, error, worst, doubt)

    case = sweep.case(value)
    dtype = sweep.dtype(value)
    given = case.rounded(dtype)
    for what, error, worst, doubt in _rasterizer(sweep, case, given, dtype, compiled):
        for quantity in error:
            yield row(
                "rasterizer",
                what,
                quantity,
                error[quantity],
                worst if quantity == "gradient" else "",
                doubt,
            )
    truth = (
        case.gaussians(torch.float64)
        if sweep.input_precision
        else given.gaussians(torch.float32).to(torch.float64)
    )
    scene = (case if sweep.input_precision else given).gaussians(dtype)
    for what, quantity, error in _scores(given, scene, truth):
        yield row("scores", what, quantity, error)
    for quantity, error in _merge(given, scene, truth).items():
        yield row("merge", "merge", quantity, error)
    for quantity, (error, worst) in _refiner(scene, truth).items():
        yield row("refiner", "refiner", quantity, error, worst)


def _rasterizer(sweep: Sweep, case: Case, given: Case, dtype: torch.dtype, compiled: bool):
    """Name, errors by quantity, worst kind of parameter, and doubt, of each rasterizer."""
    truth = picture(given, "reference", torch.float64)
    doubt = max(errors(picture(given, "eager", torch.float64), truth)[0].values())
    wanted = truth
    if sweep.input_precision:
        wanted = picture(case, "reference", torch.float64)
    yield "rounded input", *errors(truth, picture(case, "reference", torch.float64)), doubt
    yield (
        "eager",
        *errors(picture(given, "eager", dtype), wanted),
        doubt,
    )  # it takes half precision as it is
    if compiled:
        arithmetic = torch.float64 if dtype == torch.float64 else torch.float32
        yield "compiled", *errors(picture(given, "compiled", arithmetic), wanted), doubt


def picture(case: Case, what: str, dtype: torch.dtype) -> Picture:
    """Draw a case and differentiate it.

    Args:
        case: what to draw.
        what: ``reference``, ``eager`` or ``compiled``.
        dtype: of the tensors handed over.
    """
    leaves = {
        name: getattr(case, name).to(dtype, copy=True).requires_grad_() for name in PARAMETERS
    }
    camera = torch.promote_types(dtype, torch.float32)
    view = case.viewmat.to(camera)
    K = case.K.to(camera)
    if what == "reference":
        image, alpha, depth = rasterize_reference(
            *leaves.values(),
            view,
            K,
            WIDTH,
            HEIGHT,
            case.near,
            math.inf,
            sh_degree=3,
            antialiased=case.antialiased,
        )
    else:
        renders, alphas, _ = rasterization(
            *leaves.values(),
            view[None],
            K[None],
            WIDTH,
            HEIGHT,
            case.near,
            math.inf,
            sh_degree=3,
            render_mode="RGB+D",
            rasterize_mode="antialiased" if case.antialiased else "classic",
            compiled=what == "compiled",
        )
        image = renders[0, ..., :3]
        alpha = alphas[0]
        depth = renders[0, ..., 3:]
    far = float(torch.linalg.vector_norm(case.means - _centre(case), dim=1).max())
    pixels = torch.cat([image, alpha, depth / far], dim=-1)
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(pixels.shape, generator=generator, dtype=torch.float64)
    total = (pixels * weights.to(pixels)).sum()
    grads = dict.fromkeys(leaves, torch.zeros(()))
    if total.requires_grad:
        found = torch.autograd.grad(total, list(leaves.values()), materialize_grads=True)
        grads = dict(zip(leaves, (grad.double() for grad in found), strict=True))
        # by means in units of the scene's size, by directions of quaternions, by log-scales
        grads["means"] *= case.scales.median()
        grads["quats"] *= case.quats.norm(dim=1, keepdim=True)
        grads["scales"] *= case.scales
    return Picture(pixels.detach().double(), grads, far)


def _centre(case: Case) -> Tensor:
    return torch.linalg.solve(case.viewmat[:3, :3], -case.viewmat[:3, 3])


def errors(got: Picture, wanted: Picture) -> tuple[dict[str, float], str]:
    """Relative errors of image and gradient, and the kind of parameter with the worst gradient."""
    off = (got.pixels - wanted.pixels).abs().amax((0, 1)) / wanted.pixels.abs().amax(
        (0, 1)
    ).clamp_min(1e-300)
    error, worst = _worst(got.grads, wanted.grads)
    return {"image": _finite(off.max()), "gradient": error}, worst


def _worst(got: dict[str, Tensor], wanted: dict[str, Tensor]) -> tuple[float, str]:
    """The largest error by name, relative to the norm of each tensor, and its name."""
    least = LEAST_GRADIENT * max(float(value.norm()) for value in wanted.values())
    found = {
        name: _finite((got[name] - value).double().norm() / max(float(value.norm()), least, 1e-300))
        for name, value in wanted.items()
    }
    worst = max(found, key=lambda name: found[name])
    return found[worst], worst


def _finite(error: Tensor) -> float:
    return float(error) if bool(error.isfinite()) else math.inf


def _scores(given: Case, scene: Gaussians, truth: Gaussians) -> Iterator[tuple[str, str, float]]:
    views = given.views()
    kinds = {
        "paper": paper_score,
        "LightGaussian": functools.partial(lightgaussian_score, views=views),
        "PUP-3DGS": functools.partial(pup_score, views=views),
    }
    for name, score in kinds.items():
        got = score(scene).double()
        wanted = score(truth)
        same = got.isfinite() == wanted.isfinite()
        both = got.isfinite() & wanted.isfinite()
        span = wanted[both].max() - wanted[both].min() if bool(both.any()) else torch.zeros(())
        off = (got - wanted)[both].abs().amax() if bool(both.any()) else torch.zeros(())
        error = _finite(off / span.clamp_min(1e-300)) if bool(same.all()) else math.inf
        yield name, "score", error if float(off) else (0.0 if bool(same.all()) else math.inf)


def _merge(given: Case, scene: Gaussians, truth: Gaussians) -> dict[str, float]:
    centre, size = content_size(truth)  # of equal Gaussians it is a matter of ties, and only a unit
    everyone = torch.arange(len(truth))
    equal = torch.ones(len(truth))
    states = [
        initial_state(Participants(part, everyone, centre, size), equal, dtype=dtype)
        for part, dtype in ((scene, torch.float32), (truth, torch.float64))
    ]
    near = other_neighbours(states[1].means, MERGING.neighbours)
    costs = pair_costs(states[0], near)
    wanted = pair_costs(states[1], near, dtype=torch.float64)
    there = near != torch.arange(len(near))[:, None]
    most = max(1, len(truth) // 2)
    chosen = [_pairs(near, values, most) for values in (costs, wanted)]
    smaller = [merge(part, most).scene.to(torch.float64) for part in (scene, truth)]
    images = [_colours(part, given) for part in smaller]
    return {
        "cost": _finite(((costs - wanted).abs() / wanted.abs().clamp_min(1e-300))[there].max()),
        "pairs": 1 - len(chosen[0] & chosen[1]) / max(len(chosen[1]), 1),
        "merged": _finite((images[0] - images[1]).abs().max() / images[1].max().clamp_min(1e-300)),
    }


def _pairs(near: Tensor, costs: Tensor, most: int) -> set[tuple[int, int]]:
    """What one round would merge."""
    first, second, _ = cheapest_pairs(near, costs.float())
    return set(zip(first[:most].tolist(), second[:most].tolist(), strict=True))


def _colours(scene: Gaussians, case: Case) -> Tensor:
    return ps.render(
        scene, replace(case.views(1)[0], background=torch.zeros(3, dtype=torch.float64))
    )


@functools.cache
def refiners() -> tuple[Refiner, Refiner]:
    """The refiner that ships, in float32 and in float64."""
    network = ps.load_refiner().network
    return network, copy.deepcopy(network).double()


def _refiner(scene: Gaussians, truth: Gaussians) -> dict[str, tuple[float, str]]:
    single, double = (
        _residuals(network, part) for network, part in zip(refiners(), (scene, truth), strict=True)
    )
    names = ("residual", "gradient")
    return {
        name: _worst(got, wanted) for name, got, wanted in zip(names, single, double, strict=True)
    }


def _residuals(network: Refiner, scene: Gaussians) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Residuals by attribute, and the gradients of a fixed random sum of them by each group of
    weights."""
    structure = network.prepare(scene)
    if structure is None:
        raise RuntimeError("no Gaussian of the case can be drawn")
    features = gaussian_features(scene, structure.cube, network.config.num_rest, network.dtype)
    residuals = network.residuals(features, structure)
    generator = torch.Generator().manual_seed(2)
    total = torch.zeros((), dtype=network.dtype)
    for value in residuals.values():
        weights = torch.rand(value.shape, generator=generator, dtype=torch.float64)
        total = total + (value * weights.to(value)).sum()
    groups = network.parameter_groups()
    grads = torch.autograd.grad(
        total, [p for group in groups.values() for p in group], materialize_grads=True
    )
    flat = iter(grads)
    by_group = {
        name: torch.cat([next(flat).flatten() for _ in group]) for name, group in groups.items()
    }
    return {name: value.detach() for name, value in residuals.items()}, by_group
