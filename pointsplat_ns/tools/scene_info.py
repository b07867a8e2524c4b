"""Measures a scene: file, counts, SH, up, fill, opacities, sizes, bounds and suspicious rows."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import SHORTEST
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning.sh_bands import band_energies
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.rendering.comparison.sizes import parse_resolution
from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import kind_of, read_scene, source_parts
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.view_sampling.upright import Up, up_named


@dataclass(frozen=True)
class SceneInfo:
    """The result of :func:`pointsplat_ns.info`.

    Example:
        >>> import pointsplat_ns as ps
        >>> found = ps.info(ps.example_room()[:100])
        >>> sum(found.opacities), found.suspicious
        (100, {})
    """

    file: str
    """Path of the scene; empty for Gaussians in memory, which have no format and 0 bytes."""
    format: str
    """Name of the format; for a run or its checkpoint the method and step."""
    bytes: int
    gaussians: int
    sh_degree: int
    antialiased: bool
    """Whether the scene was trained with antialiasing, according to its file or run."""
    offset: list[float]
    """Origin of positions in the frame of the file, scene units; empty if both frames are the
    same."""
    up: list[float]
    """Up direction, of length 1; empty if nothing is visible."""
    up_is_guess: bool
    """Whether the up direction is an uncertain estimate, or declared and contradicted by the
    scene."""
    up_instead: str
    """The direction that the scene suggests in place of the declared one; empty if it contradicts
    none."""
    fill: float | None
    """Mean number of Gaussians drawn per pixel in sampled views
    (:func:`pointsplat_ns.rendering.comparison.fill.fill`); None without views."""
    views: str
    """Number and size of the sampled views, as text."""
    sh_energies: list[float]
    """Mean square of the contribution of each band to the colours, from degree 1 on."""
    opacities: list[int]
    """Histogram of opacities, ten bins from 0 to 1."""
    sizes: dict[str, int]
    """Histogram of the largest standard deviation, scene units; bins are powers of ten, named by
    their lower bound."""
    bounds: list[list[float]]
    """Lower and upper corner of the bounding box of all positions."""
    content: list[list[float]]
    """Corners of the box of the middle 96 % of positions along each axis."""
    suspicious: dict[str, int]
    """Number of rows by kind of defect, without kinds that do not occur."""

    @property
    def up_text(self) -> str:
        """Name or coordinates of the up direction, and whether it is uncertain; "unknown" if
        nothing is visible."""
        if not self.up:
            return "unknown"
        return str(Up(torch.tensor(self.up, **DOUBLES), not self.up_is_guess, self.up_instead))

    def as_dict(self) -> dict[str, Any]:
        """The figures as a dictionary for JSON."""
        return dataclasses.asdict(self)


def info(
    scene: Gaussians | str | Path,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
) -> SceneInfo:
    """Measure a scene.

    Args:
        scene: N Gaussians, or the path of a scene. Undrawable Gaussians of a file count too; other
            functions drop them.
        resolution: size of the pictures for fill, pixels; by default 1920x1080.
        up: up axis, such as "-y"; by default declared by the scene, or estimated.

    Raises:
        SceneError: if the file is not usable.
        PointSplatError: if the resolution or the axis is invalid.

    Example:
        >>> import pointsplat_ns as ps
        >>> found = ps.info(ps.example_room())
        >>> found.gaussians, found.sh_degree, found.up_text
        (62845, 1, 'z (a guess)')
    """
    size = parse_resolution(resolution)
    known = up_named(up)
    file = ""
    kind = ""
    bytes_ = 0
    if not isinstance(scene, Gaussians):
        file = str(scene)
        scene = read_scene(scene, all_rows=True)
        parts = source_parts(file)
        kind = kind_of(file)
        bytes_ = sum(part.stat().st_size for part in parts)
    scene = scene.detach().to("cpu", torch.float32)
    usable = scene.usable()
    good = scene[usable]
    source = ViewProvider(good, resolution=size, up=known)
    try:
        views = source.whole()
        direction: Up | None = source.sampler.up
        mean_fill = fill(good, views)
        views_text = f"{len(views)} views of {views.width} x {views.height} pixels"
    except DataError:  # nothing is visible
        direction = known
        mean_fill = None
        views_text = ""
    return SceneInfo(
        file=file,
        format=kind,
        bytes=bytes_,
        gaussians=len(scene),
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        offset=[] if scene.offset is None else [*scene.offset],
        up=[] if direction is None else direction.direction.tolist(),
        up_is_guess=direction is not None and not direction.sure,
        up_instead="" if direction is None else direction.instead,
        fill=mean_fill,
        views=views_text,
        sh_energies=band_energies(scene),
        opacities=torch.histc(good.alphas, 10, 0.0, 1.0).long().tolist(),
        sizes=_by_powers_of_ten(good.scales.amax(dim=1)) if len(good) else {},
        bounds=_corners(good.means, 0.0),
        content=_corners(good.means, 0.02),
        suspicious=_suspicious(scene, usable),
    )


def _suspicious(scene: Gaussians, usable: Tensor) -> dict[str, int]:
    values = torch.cat([value.flatten(1) for value in scene.tensors()], dim=1)
    nan = values.isnan().any(dim=1)
    good = scene[usable]
    counts = {
        "NaN": int(nan.sum()),
        "infinite": int((~usable & ~nan).sum()),
        "opacity of exactly 0 or 1": int(good.opacities.isinf().sum()),
        "too faint to be drawn": int((good.alphas < ALPHA_MIN).sum()),
        "zero quaternion": int((good.quats.abs().amax(dim=1) < SHORTEST).sum()) if len(good) else 0,
    }
    return {defect: count for defect, count in counts.items() if count}


def _by_powers_of_ten(log_sizes: Tensor) -> dict[str, int]:
    powers = (log_sizes.double() / math.log(10)).floor()
    flat = powers.isinf()
    values, counts = powers[~flat].unique(return_counts=True)
    sizes = {
        f"1e{int(value):+03d}": int(count) for value, count in zip(values, counts, strict=True)
    }
    return {"0": int(flat.sum()), **sizes} if bool(flat.any()) else sizes


def _corners(means: Tensor, outside: float) -> list[list[float]]:
    """Corners of the box of positions, without the share ``outside`` of them at either end of each
    axis."""
    if not len(means):
        return []
    ranked = means.sort(dim=0).values
    last = len(means) - 1
    return [ranked[round(outside * last)].tolist(), ranked[round((1 - outside) * last)].tolist()]
