"""What SPZ can hold, and how a scene is brought into its range: bits of positions, far Gaussians, colours."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats.holding import Holds, Span, typical_sizes, within_colours

FRACTION_BITS, MAX_FRACTION_BITS = 12, 23
"""Bits of a position after the point: usually, in steps of 0.00024 within 2048 units, and at most. Scenes of smaller
Gaussians get more, and scenes that reach farther get fewer."""

FARTHEST = 2**23 - 1
"""Steps of positions from the origin, at most."""

SIZES = Span(-10.0, -10.0 + 255 / 16, 1 / 16)
"""Log-scales."""

COLOUR_SCALE = 0.15
COLOURS = Span(-0.5 / COLOUR_SCALE, 0.5 / COLOUR_SCALE, 1 / (255 * COLOUR_SCALE))
SH = Span(-1.0, 127 / 128, 1 / 128)


def fitted(scene: Gaussians) -> tuple[Gaussians, str]:
    """A scene, float32 on the CPU, in the range of SPZ, and which Gaussians were moved, in words.

    If few Gaussians, at most 1 %, are so far away that positions of all others would become coarse, they move towards
    the median position and shrink in proportion: from there they look the same. Colours are as of
    :func:`within_colours`.
    """
    scene = within_colours(scene, COLOURS, SH)
    if not len(scene):
        return scene, ""
    needed = _needed_bits(scene)
    if _fitting_bits(scene) >= needed:
        return scene, ""
    bits = max(needed, FRACTION_BITS)
    reach = math.ldexp(FARTHEST - 1, -bits)
    far = scene.means.abs().amax(dim=1) > reach
    count = int(far.sum())
    if count > math.ceil(0.01 * len(scene)) or count == len(scene):
        return scene, ""
    centre = scene.means[~far].double().median(dim=0).values
    ways = scene.means[far].double() - centre
    room = torch.where(ways < 0, reach + centre, reach - centre)
    share = (room / ways.abs().clamp_min(1e-300)).amin(dim=1).clamp_min(1e-6)
    means, scales = scene.means.clone(), scene.scales.clone()
    means[far] = (centre + share[:, None] * ways).float()
    scales[far] += share.log()[:, None].float()
    plural, verb = ("Gaussians lie", "are") if count > 1 else ("Gaussian lies", "is")
    moved = f"{count} {plural} farther than {reach:.4g} units and {verb} moved to there, smaller in proportion"
    return scene.replace(means=means, scales=scales), moved


def fraction_bits(scene: Gaussians) -> int:
    """Bits after the point of the positions of a scene that is :func:`fitted`. Raises SceneError if a Gaussian is out
    of reach."""
    fitting, bits = _fitting_bits(scene), max(_needed_bits(scene), FRACTION_BITS)
    if not _is_exact(scene, bits) and _is_exact(scene, bits + 1):  # of an SPZ file, whose sizes are rounded
        bits += 1
    bits = min(fitting, bits)
    if bits < 0:
        farthest = float(scene.means.abs().max())
        raise SceneError(
            f"a Gaussian lies {farthest:.3g} units from the origin; SPZ reaches to {FARTHEST}; scale the scene down"
        )
    return bits


def _is_exact(scene: Gaussians, bits: int) -> bool:
    levels = scene.means.double() * 2.0**bits
    return torch.equal(levels, levels.round())


def _fitting_bits(scene: Gaussians) -> int:
    """Bits after the point with which all positions fit into 24 bits, at most as many as there are."""
    farthest = float(scene.means.abs().max()) if len(scene) else 0.0
    return min(math.floor(math.log2(FARTHEST / farthest)) if farthest > 0 else MAX_FRACTION_BITS, MAX_FRACTION_BITS)


def _needed_bits(scene: Gaussians) -> int:
    """Bits after the point with which the median size of a Gaussian has at least 8 steps of positions."""
    if not len(scene):
        return FRACTION_BITS
    size = float(typical_sizes(scene).median())
    return min(max(math.ceil(math.log2(8 / size)), 0), MAX_FRACTION_BITS)


def _position_steps(scene: Gaussians) -> Tensor:
    return scene.means.new_full((len(scene),), math.ldexp(1.0, -fraction_bits(scene)))


HOLDS = Holds(sizes=SIZES, colours=COLOURS, sh=SH, position_steps=_position_steps, fitted=fitted)
