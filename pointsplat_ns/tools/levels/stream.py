"""Writes levels of detail as a streamed SOG, and divides the levels into leaves of its tree.

Levels are nested, so a leaf has the same part of the scene in every level: the descendants of some
Gaussians of the coarsest level. Where leaves of different levels meet, nothing is drawn twice and
nothing is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.scene.formats import STREAM_META, format_to_write
from pointsplat_ns.scene.formats.sog_stream import Node, write_sog_stream
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import warn_of_losses
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import INDICES
from pointsplat_ns.tools.levels.tree import Parts, grouped, halved, leaves
from pointsplat_ns.view_sampling.content import content_size


def write_stream(
    folder: Path,
    levels: Sequence[Gaussians],
    parents: Sequence[Tensor],
    progress: Progress = silent,
    force: bool = True,
) -> list[int]:
    """Write levels of detail as a streamed SOG.

    Args:
        folder: created if it is missing.
        levels, parents, progress, force: as for
            :func:`~pointsplat_ns.tools.levels.tiles_3d.write_tiles`.

    Returns:
        The number of written Gaussians per level.

    Raises:
        SceneError: if a file cannot be written.
    """
    scenes = [level.detach().to("cpu", torch.float32) for level in levels]
    warn_of_losses(format_to_write(".sog"), scenes[0], folder)
    most = 1 << 19
    tree = partition(scenes, [of.cpu().long() for of in parents], most)
    path = folder / STREAM_META
    return write_sog_stream(scenes, tree, path, most, progress, force)["counts"]


def partition(
    levels: Sequence[Gaussians],
    parents: Sequence[Tensor],
    most: int,
    extent: float | None = None,
    least: int = 8192,
) -> Node:
    """A tree whose leaves contain the descendants of neighbours in the coarsest level, in Morton
    order.

    Args:
        levels, parents: as for :func:`write_stream`.
        most: maximum number of Gaussians of the finest level in a leaf.
        extent: maximum side of a leaf, scene units; by default an eighth of the diagonal of the
            content.
        least: number of Gaussians of the finest level up to which a leaf is not cut for its extent.
            Viewers choose a level per leaf, so leaves of few Gaussians cost more than they save.
    """
    coarsest = levels[-1]
    ancestors = [torch.arange(len(coarsest), **INDICES)]
    for of in reversed(parents):
        ancestors.insert(0, torch.where(of >= 0, ancestors[0][of.clamp_min(0)], -1))
    present = ancestors[0] >= 0
    weights = torch.bincount(ancestors[0][present], minlength=len(coarsest))
    extent = content_size(coarsest)[1] / 8 if extent is None else extent
    parts = halved(coarsest.means, weights, most, extent, least)
    members = leaves(parts)
    leaf_of = torch.empty(len(coarsest), **INDICES)
    for number, leaf in enumerate(members):
        leaf_of[leaf] = number
    groups = (torch.where(of >= 0, leaf_of[of.clamp_min(0)], -1) for of in ancestors)
    rows = [
        grouped(scene, group, len(members)) for scene, group in zip(levels, groups, strict=True)
    ]
    filled = iter(Node(rows=leaf) for leaf in zip(*rows, strict=True))

    def node(part: Parts) -> Node:
        if isinstance(part, Tensor):
            return next(filled)
        return Node(children=(node(part[0]), node(part[1])))

    return node(parts)
