"""One way to a smaller scene, whatever the method: a score that chooses, or merging."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.budget import Keep, resolve_keep
from pointsplat_ns.pruning.select import SCORES, need_usable, prune

MERGE = "merge"
"""Neighbours are replaced by one Gaussian each, where a score only leaves Gaussians out."""

METHODS = (MERGE, *SCORES)
"""What :func:`compact` knows, the best first."""


def compact(
    scene: Gaussians,
    keep: Keep,
    by: str = MERGE,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> Gaussians:
    """A scene of fewer Gaussians.

    Args:
        scene: N Gaussians.
        keep: ratio, count or size (see :func:`~pointsplat_ns.pruning.budget.resolve_keep`).
        by: one of :data:`METHODS`. A score keeps Gaussians bit for bit as they were, in their old order.
        progress: called with the share done, in [0, 1], by a method that takes long enough.
        **options: of that score.

    Returns:
        Exactly the resolved number of Gaussians.

    Raises:
        BudgetError: if no such number can be kept.
        SceneError: if no Gaussian of the scene can be drawn.
        PointSplatError: if there is no such method.
    """
    if by == MERGE:
        count = resolve_keep(len(scene), keep, scene.sh_degree)
        need_usable(scene)
        from pointsplat_ns.pruning.merging import merge

        return merge(scene, count, progress=progress, **options).scene
    if by not in SCORES:
        raise PointSplatError(f"no method is called {by!r}; expected one of {', '.join(METHODS)}")
    return prune(scene, keep, by, **options).scene
