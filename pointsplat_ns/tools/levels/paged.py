"""Writes levels of detail as a RAD file: a tree of the Gaussians of all levels with one root."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.pruning.merging import merge_levels
from pointsplat_ns.scene.formats import format_named
from pointsplat_ns.scene.formats.rad import MOST_CHILDREN, encode_rad
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import warn_of_losses
from pointsplat_ns.system.files import replacing
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import INDICES
from pointsplat_ns.tools.levels.tree import grouped


def write_paged(
    path: Path | str,
    levels: Sequence[Gaussians],
    parents: Sequence[Tensor],
    progress: Progress = silent,
) -> int:
    """Write levels of detail as a RAD file. The coarsest level is merged further, to one Gaussian.

    Args:
        path: the file.
        levels, parents, progress: as for :func:`~pointsplat_ns.tools.levels.tiles_3d.write_tiles`.

    Returns:
        The number of Gaussians written.

    Raises:
        SceneError: if a Gaussian has too many children for the format, or the file cannot be
            written.
    """
    path = Path(path)
    kind = format_named(".rad")
    scenes = [level.detach().to("cpu", torch.float32) for level in levels]
    assert kind is not None
    warn_of_losses(kind, scenes[0], path)
    above = [of.cpu() for of in parents]
    while len(scenes[-1]) > 1:
        (merged,) = merge_levels(scenes[-1], [max(len(scenes[-1]) // 8, 1)])
        above.append(merged.assignment)
        scenes.append(merged.scene)
    order = torch.zeros(1, **INDICES)
    parts = [scenes[-1]]
    children = []
    starts = []
    written = 1
    for scene, coarser, parent in zip(scenes[-2::-1], scenes[:0:-1], above[::-1], strict=True):
        position = torch.full((len(coarser),), -1, **INDICES)
        position[order] = torch.arange(len(order), **INDICES)
        families = grouped(scene, torch.where(parent >= 0, position[parent], -1), len(order))
        counts = torch.tensor([*map(len, families)], **INDICES)
        if int(counts.max()) > MOST_CHILDREN:
            raise SceneError(
                f"{path}: a Gaussian stands for {int(counts.max())} of the next level; expected at "
                f"most {MOST_CHILDREN}; make more levels"
            )
        children.append(counts)
        starts.append(written + counts.cumsum(0) - counts)
        order = torch.cat(families)
        parts.append(scene[order])
        written += len(order)
    leaves = torch.zeros(len(order), **INDICES)
    data = encode_rad(
        Gaussians.cat(parts), torch.cat([*children, leaves]), torch.cat([*starts, leaves]), progress
    )
    with replacing(path, len(data)) as part:
        part.write_bytes(data)
    return written
