"""Figures of a scene: counts, SH, opacities, sizes, bounds, suspicious rows, and sizes of files."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.quaternions import SHORTEST
from pointsplat_ns.io.files import unusable_kept
from pointsplat_ns.io.formats import FORMATS, Format
from pointsplat_ns.io.scene import read_scene
from pointsplat_ns.pruning.duplicates import Copies
from pointsplat_ns.pruning.sh_bands import band_energies
from pointsplat_ns.rasterizer.constants import ALPHA_MIN
from pointsplat_ns.system.progress import silent


@dataclass(frozen=True)
class SceneInfo:
    """The result of :func:`pointsplat_ns.info`.

    Example:
        >>> import pointsplat_ns as ps
        >>> found = ps.info(ps.example_room()[:100])
        >>> sum(found.opacities), found.suspicious
        (100, {})
    """

    gaussians: int
    sh_degree: int
    sh_energies: list[float]
    """Mean square of the contribution of each band to the colours, from degree 1 on."""
    opacities: list[int]
    """Gaussians by opacity, in ten bins from 0 to 1."""
    sizes: dict[str, int]
    """Gaussians by their largest standard deviation, scene units: powers of ten, by their lower bound."""
    bounds: list[list[float]]
    """Lowest and highest corner of all positions."""
    content: list[list[float]]
    """Corners of the middle 96 % of positions along each axis."""
    suspicious: dict[str, int]
    """Number of rows by kind of defect; kinds without rows are left out."""
    file_bytes: dict[str, dict[str, int]]
    """Bytes of a file by format and share of the Gaussians that is kept. Sizes of ``.spz`` are estimates,
    without an entry where the scene is too large for the format."""

    def as_dict(self) -> dict[str, Any]:
        """The figures as numbers, lists and dictionaries that JSON can hold."""
        return dataclasses.asdict(self)


def info(scene: Gaussians | str | Path) -> SceneInfo:
    """Measure a scene.

    Args:
        scene: N Gaussians, or the path of a scene. Undrawable Gaussians of a file are counted too; other functions drop
            them when reading.

    Raises:
        SceneError: if the file is not usable.

    Example:
        >>> import pointsplat_ns as ps
        >>> found = ps.info(ps.example_room())
        >>> found.gaussians, found.sh_degree, found.file_bytes[".splat"]["10%"]
        (62845, 1, 201120)
    """
    if not isinstance(scene, Gaussians):
        with unusable_kept():
            scene = read_scene(scene)
    scene = scene.detach().to("cpu", torch.float32)
    usable = scene.usable()
    good = scene[usable]
    return SceneInfo(
        gaussians=len(scene),
        sh_degree=scene.sh_degree,
        sh_energies=band_energies(scene),
        opacities=torch.histc(good.alphas, 10, 0.0, 1.0).long().tolist(),
        sizes=_by_powers_of_ten(good.scales.amax(dim=1)) if len(good) else {},
        bounds=_corners(good.means, 0.0),
        content=_corners(good.means, 0.02),
        suspicious=_suspicious(scene, usable),
        file_bytes={kind.suffix: sizes for kind in FORMATS if (sizes := _sizes(kind, good))},
    )


def _suspicious(scene: Gaussians, usable: Tensor) -> dict[str, int]:
    found = torch.cat([value.flatten(1) for value in scene.tensors()], dim=1)
    nan = found.isnan().any(dim=1)
    good = scene[usable]
    counts = {
        "NaN": int(nan.sum()),
        "infinite": int((~usable & ~nan).sum()),
        "opacity of exactly 0 or 1": int(good.opacities.isinf().sum()),
        "too faint to be drawn": int((good.alphas < ALPHA_MIN).sum()),
        "zero quaternion": int((good.quats.abs().amax(dim=1) < SHORTEST).sum()) if len(good) else 0,
        "exact copy of another": len(good) - Copies(good, torch.arange(len(good))).distinct if len(good) else 0,
    }
    return {what: count for what, count in counts.items() if count}


def _by_powers_of_ten(log_sizes: Tensor) -> dict[str, int]:
    powers = (log_sizes.double() / math.log(10)).floor()
    flat = powers.isinf()
    values, counts = powers[~flat].unique(return_counts=True)
    sizes = {f"1e{int(value):+03d}": int(count) for value, count in zip(values, counts, strict=True)}
    return {"0": int(flat.sum()), **sizes} if bool(flat.any()) else sizes


def _corners(means: Tensor, outside: float) -> list[list[float]]:
    """Corners of the box of the positions, without the share ``outside`` of them at each end of each axis."""
    if not len(means):
        return []
    ranked = means.sort(dim=0).values
    last = len(means) - 1
    return [ranked[round(outside * last)].tolist(), ranked[round((1 - outside) * last)].tolist()]


def _sizes(kind: Format, scene: Gaussians) -> dict[str, int]:
    """Bytes of a file by share of the Gaussians. SPZ is estimated from up to 20,000 of them; empty for SOG and formats
    without a size."""
    counts = {f"{share:.0%}": int(share * len(scene) + 0.5) for share in (1.0, 0.5, 0.3, 0.1, 0.03)}
    if kind.bytes_of is not None:
        return {text: kind.bytes_of(count, scene.sh_degree) for text, count in counts.items()}
    if kind.suffix != ".spz" or kind.encode is None:  # the palette of SOG does not grow with the scene
        return {}
    sample = scene[:: max(-(-len(scene) // 20_000), 1)]
    try:
        each = len(kind.encode(sample, silent)) / max(len(sample), 1)
    except SceneError:  # positions that do not fit 24 bits
        return {}
    return {text: round(each * count) for text, count in counts.items()}
