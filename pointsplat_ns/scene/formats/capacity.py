"""The range of each attribute in a format, and the losses of a scene written in it.

Each format declares its ranges (:class:`Holds`). :func:`losses` compares a scene with them before
it is written. Small losses that the format has by design, such as its steps of sizes, are not
counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.harmonics import SH_C0, basis_rows
from pointsplat_ns.scene.formats.rounding import weights
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.offsets import offset_text
from pointsplat_ns.system.tensors import DOUBLES

_DARKEST = (-0.44 - 0.5) / SH_C0
"""Constant SH coefficient below which all colours are black."""


@dataclass(frozen=True)
class Span:
    """Range of one attribute in a format."""

    low: float = -math.inf
    high: float = math.inf
    step: float = 0.0
    """Distance of neighbouring values; 0 for float32, or if it depends on the scene."""

    def holds(self, values: Tensor) -> Tensor:
        """Whether values are in the range, extended by half a step."""
        return (values >= self.low - 0.5 * self.step) & (values <= self.high + 0.5 * self.step)


FLOAT = Span()
"""The range of float32."""


@dataclass(frozen=True)
class Holds:
    """Ranges of all attributes in a format."""

    sizes: Span = FLOAT
    """Natural logarithms of standard deviations in scene units."""
    colours: Span = FLOAT
    """Constant SH coefficients."""
    sh: Span | None = FLOAT
    """The other SH coefficients; None if the format has none."""
    position_steps: Callable[[Gaussians], Tensor] | None = None
    """Position steps (N,) of a scene; None if a float32 scene loses nothing."""
    antialiased: bool = True
    """Whether files record that a scene was trained with antialiasing."""
    offset: bool = False
    """Whether files record the offset of positions."""
    fitted: Callable[[Gaussians], tuple[Gaussians, str]] | None = None
    """Returns the scene as written, moved into the format's range with little loss, and a
    description of the changes."""


def losses(scene: Gaussians, holds: Holds) -> list[str]:
    """Losses of a scene, float32 on the CPU, in a format: one clause with numbers per attribute.
    An attribute is omitted if the format can hold it, or if it changes in at most 1 % of the
    Gaussians, by their weight in renders."""
    found = []
    if scene.antialiased and not holds.antialiased:
        found.append("the flag for antialiased training")
    if scene.offset is not None and not holds.offset:
        found.append(f"the position offset {offset_text(scene.offset)}")
    if not len(scene):
        return found
    fitted, moved = (scene, "") if holds.fitted is None else holds.fitted(scene)
    found += [moved] if moved else []
    if holds.position_steps is not None:
        steps = holds.position_steps(fitted).double()
        times = float((steps / typical_sizes(fitted)).median())
        misplaced = _share(steps > fitted.scales.double().amax(dim=1).exp(), fitted)
        if times > 0.25:  # at a quarter, renders have about 42 to 52 dB
            found.append(
                f"positions are rounded to {float(steps.median()):.2g} units, {times:.2g} times "
                "the median size of a Gaussian"
            )
        elif misplaced > 0.0025:  # real splats have at most 0.0004
            found.append(
                f"positions of {_percent(misplaced)} of the Gaussians are rounded by more than "
                "their size"
            )
    ordered = scene.scales.sort(dim=1).values
    sizes = holds.sizes
    # smaller ones are drawn at the smallest size
    drawn = scene.replace(scales=scene.scales.clamp_min(sizes.low))
    found += _cut(ordered[:, 1] < sizes.low, drawn, "smaller", sizes.low, "larger")
    found += _cut(ordered[:, 2] > sizes.high, scene, "larger", sizes.high, "smaller")
    if holds.sh is None and scene.sh_degree:
        found.append(
            f"SH of degree {scene.sh_degree} are dropped, so colours no longer depend on the view "
            "direction"
        )
    error = _colour_errors(scene, fitted, holds)
    share = _share(error > 0.2, scene)
    if share > 0.01:
        found.append(
            f"{_percent(share)} of the Gaussians have colours out of range, by up to "
            f"{float(error.max()):.2g} of white"
        )
    return found


def typical_sizes(scene: Gaussians) -> Tensor:
    """Middle standard deviation (N,) of each Gaussian, float64, scene units, above 0."""
    return scene.scales.double().median(dim=1).values.clamp(-200.0, 200.0).exp()


def seen_colours(dc: Tensor, rest: Tensor) -> Tensor:
    """Colours (..., D) in D directions that cover the sphere, from constant SH coefficients (...)
    and the others (..., K); negative colours become 0, as in rendering."""
    basis = _basis(rest.shape[-1]).to(rest)
    return (0.5 + SH_C0 * dc[..., None] + rest @ basis).clamp_min(0.0)


def _basis(count: int) -> Tensor:
    """The first ``count`` basis functions above degree 0, (count, D) float64, in directions on a
    spiral."""
    number = torch.arange(64, **DOUBLES)
    z = 1 - (2 * number + 1) / 64
    angle = number * math.pi * (3 - math.sqrt(5))
    radius = (1 - z.square()).sqrt()
    rows = basis_rows(torch.stack([radius * angle.cos(), radius * angle.sin(), z]), 3)
    return torch.stack(rows[1 : count + 1]) if count else torch.zeros(0, len(z), **DOUBLES)


def within_colours(scene: Gaussians, colours: Span, sh: Span) -> Gaussians:
    """A scene with SH coefficients in range that looks as similar as possible in all directions.

    Negative colours are drawn as 0. So a constant coefficient that is black in all directions may
    rise, and others may rise if the higher coefficients shrink with them. For each Gaussian and
    channel out of range, the candidate with the least squared error of :func:`seen_colours` is
    chosen, among these pairs and the coefficients clipped to the ranges.
    """
    # (N, 3), (N, 3, K)
    dc = scene.features_dc
    rest = scene.features_rest.transpose(1, 2)
    dark = (dc < _DARKEST).nonzero(as_tuple=True)
    if len(dark[0]):
        unseen = (-0.5 - _peaks(rest[dark])) / SH_C0  # black in all directions if dc is lower
        dc = dc.index_put(dark, torch.maximum(dc[dark], unseen.clamp_max(_DARKEST)))
        scene = scene.replace(features_dc=dc)
    outside = ~(colours.holds(dc) & sh.holds(rest).all(dim=2))
    if not bool(outside.any()):
        return scene
    new_dc = dc.clone()
    new_rest = rest.clone()
    rows = outside.nonzero()
    for part in rows.split(4096):
        at = part[:, 0], part[:, 1]
        new_dc[at], new_rest[at] = _most_alike(dc[at], rest[at], colours, sh)
    return scene.replace(features_dc=new_dc, features_rest=new_rest.transpose(1, 2).contiguous())


def _most_alike(dc: Tensor, rest: Tensor, colours: Span, sh: Span) -> tuple[Tensor, Tensor]:
    """The coefficients of :func:`within_colours` for R channels: (R,) and (R, K)."""
    wanted = seen_colours(dc, rest)
    least = wanted.new_full(dc.shape, math.inf)
    best_dc = dc.clamp(colours.low, colours.high)
    best_rest = rest.clamp(sh.low, sh.high)
    largest = rest.abs().amax(dim=1) if rest.shape[1] else torch.zeros_like(dc)
    fitting = (min(-sh.low, sh.high) / largest.clamp_min(1e-30)).clamp_max(1.0)
    peak = _peaks(rest)
    dark = torch.full_like(dc, _DARKEST)
    seen = (rest @ _basis(rest.shape[1]).to(rest)).amax(dim=1)

    def offer(new_dc: Tensor, new_rest: Tensor) -> None:
        nonlocal least, best_dc, best_rest
        error = (seen_colours(new_dc, new_rest) - wanted).square().sum(dim=1)
        better = error < least
        least = torch.where(better, error, least)
        best_dc = torch.where(better, new_dc, best_dc)
        best_rest = torch.where(better[:, None], new_rest, best_rest)

    for sixteenths in range(17):
        factor = sixteenths / 16 * fitting
        for new_dc in (
            dark,
            *(dc + (1 - factor) * highest / SH_C0 for highest in (peak, seen)),
            dc,
        ):
            offer(new_dc.clamp(colours.low, colours.high), factor[:, None] * rest)
    offer(dc.clamp(colours.low, colours.high), rest.clamp(sh.low, sh.high))
    return best_dc, best_rest


def _peaks(rest: Tensor) -> Tensor:
    """Upper bound (R,) of the colour that SH coefficients (R, K) above degree 0 add: their norm
    times the norm of the basis, whose squares sum to K / (4 pi) in every direction."""
    return rest.norm(dim=1) * math.sqrt(rest.shape[1] / (4 * math.pi))


def _colour_errors(scene: Gaussians, fitted: Gaussians, holds: Holds) -> Tensor:
    """Largest colour error (N,) over directions and channels after clipping the fitted scene to the
    ranges. Bands that the format drops are not counted."""
    kept = scene.features_rest.shape[1] if holds.sh is not None else 0
    span = holds.sh or FLOAT
    pairs = [
        (one.features_dc, one.features_rest[:, :kept].transpose(1, 2)) for one in (scene, fitted)
    ]
    (dc, rest), (new_dc, new_rest) = pairs
    error = torch.zeros_like(dc)
    changed = ~(holds.colours.holds(dc) & span.holds(rest).all(dim=2)) | (dc != new_dc)
    for part in changed.nonzero().split(16_384):
        at = part[:, 0], part[:, 1]
        held = (
            new_dc[at].clamp(holds.colours.low, holds.colours.high),
            new_rest[at].clamp(span.low, span.high),
        )
        error[at] = (seen_colours(*held) - seen_colours(dc[at], rest[at])).abs().amax(dim=1)
    return error.amax(dim=1)


def _cut(mask: Tensor, scene: Gaussians, than: str, limit: float, drawn: str) -> list[str]:
    if _weight(mask, scene) <= 0.01:
        return []
    count = _percent(float(mask.double().mean()))
    return [
        f"{count} of the Gaussians are {than} than {math.exp(limit):.2g} units and become {drawn}"
    ]


def _share(mask: Tensor, scene: Gaussians) -> float:
    """Share of Gaussians, by count or by weight, whichever is larger."""
    return max(float(mask.double().mean()), _weight(mask, scene))


def _weight(mask: Tensor, scene: Gaussians) -> float:
    """Share of Gaussians by their weight in renders."""
    if not bool(mask.any()):
        return 0.0
    each = weights(scene)
    return float(each[mask].sum() / each.sum())


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else "all"
