"""The registry of pruning methods, and the one way through it: from a scene and a budget to a smaller scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError, DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.budget import Keep, resolve_keep
from pointsplat_ns.pruning.coverage import coverage_score
from pointsplat_ns.pruning.merge import merge
from pointsplat_ns.pruning.scores import (
    area_score,
    authors_score,
    log_volume_score,
    opacity_score,
    paper_score,
    random_score,
    volume_score,
)
from pointsplat_ns.pruning.select import select
from pointsplat_ns.pruning.view_scores import lightgaussian_score, pup_score
from pointsplat_ns.views import Views


@dataclass(frozen=True)
class Method:
    """How a scene may be made smaller."""

    name: str
    summary: str
    """One clause for a person."""
    score: Callable[..., Tensor] | None
    """From a scene (and views, if it needs them) to the scores (N,) that decide what stays; None for merging."""
    needs_views: bool = False
    """Whether the score looks at the scene from poses."""
    weighs_opacity: bool = False
    """Whether the score takes ``opacity_weight``."""


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("merge", "neighbours become one Gaussian each; by far the best", None),
        Method("coverage", "each neighbourhood keeps its share of opacity and area", coverage_score),
        Method("paper", "eq. 3 of the paper: opacity and volume", paper_score, weighs_opacity=True),
        Method("authors", "the formula of the paper's released code", authors_score, weighs_opacity=True),
        Method("opacity", "the most opaque", opacity_score),
        Method("volume", "the largest", volume_score),
        Method("log-volume", "eq. 3 with the logarithm of the volume", log_volume_score, weighs_opacity=True),
        Method("area", "opacity times the area of the broad side", area_score),
        Method("random", "any, the same ones for one seed", random_score),
        Method("lightgaussian", "LightGaussian's global significance", lightgaussian_score, needs_views=True),
        Method("pup", "PUP-3DGS's spatial sensitivity", pup_score, needs_views=True),
    )
}
"""All methods by name, the best first."""


def method_named(by: str) -> Method:
    """The method of a name.

    Raises:
        PointSplatError: if there is none.
    """
    if by not in METHODS:
        raise PointSplatError(f"no method is called {by!r}; expected one of {', '.join(METHODS)}")
    return METHODS[by]


@dataclass(frozen=True)
class PruneSettings:
    """How a scene is to be pruned, where that is decided once for many scenes.

    Raises:
        PointSplatError: if there is no such method, it needs views, or it does not weigh opacity and is given a weight.
        BudgetError: if ``keep`` is neither a ratio nor a count.
    """

    keep: float | int
    """Ratio (float, at most 1) or count (int)."""
    by: str = "merge"
    opacity_weight: float | None = None
    """Lambda of the methods that weigh opacity; None is the paper's."""

    def __post_init__(self) -> None:
        keep = self.keep
        if not 0 < keep < math.inf or (keep > 1 and keep != int(keep)):  # NaN fails too
            raise BudgetError(
                f"keep is {keep:g}; expected a ratio above 0 and up to 1 (such as 0.3) or a whole number of Gaussians "
                "(such as 50000)"
            )
        if keep > 1:  # configuration files write counts as floats
            object.__setattr__(self, "keep", int(keep))
        method = method_named(self.by)
        if method.needs_views:
            raise PointSplatError(f"{self.by} looks at a scene from poses; expected a method that needs none")
        check_opacity_weight(method, self.opacity_weight)

    def prune(self, scene: Gaussians) -> Gaussians:
        """A scene pruned so; see :func:`prune`."""
        return prune(scene, self.keep, self.by, opacity_weight=self.opacity_weight)


def prune(
    scene: Gaussians,
    keep: Keep | str,
    by: str = "merge",
    views: Views | Callable[[], Views] | None = None,
    opacity_weight: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Gaussians:
    """A scene of fewer Gaussians.

    Args:
        scene: N Gaussians.
        keep: ratio, count or size (see :func:`~pointsplat_ns.pruning.budget.resolve_keep`).
        by: one of :data:`METHODS`. A score keeps Gaussians bit for bit as they were, in their old order.
        views: where methods that look at the scene look from, or what gives it when it is due.
        opacity_weight: lambda of the methods that weigh opacity; by default the paper's.
        progress: called with the share done, in [0, 1].

    Returns:
        Exactly the resolved number of Gaussians.

    Raises:
        BudgetError: if no such number can be kept.
        SceneError: if no Gaussian of the scene can be drawn.
        DataError: if the method needs views and there are none.
        PointSplatError: if there is no such method, or it does not weigh opacity and is given a weight.
    """
    method = method_named(by)
    check_opacity_weight(method, opacity_weight)
    count = resolve_keep(len(scene), keep, scene.sh_degree)
    need_usable(scene)
    if method.score is None:
        return merge(scene, count, progress=progress).scene
    return scene[select(score_of(scene, method, views, opacity_weight, progress), count)]


@torch.no_grad()
def score_of(
    scene: Gaussians,
    method: Method,
    views: Views | Callable[[], Views] | None = None,
    opacity_weight: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Tensor:
    """Scores (N,) float64 of a scene by a method that has a score; arguments as those of :func:`prune`."""
    assert method.score is not None, f"{method.name} has no score"
    if method.needs_views:
        if views is None:
            raise DataError(f"{method.name} looks at the scene from poses; expected views")
        return method.score(scene, views() if callable(views) else views, progress=progress)
    if opacity_weight is not None:
        return method.score(scene, opacity_weight=opacity_weight)
    return method.score(scene)


def check_opacity_weight(method: Method, opacity_weight: float | None) -> None:
    """Refuse a weight that a method would not look at.

    Raises:
        PointSplatError: if it is given and the method does not weigh opacity.
    """
    if opacity_weight is not None and not method.weighs_opacity:
        weighing = ", ".join(other.name for other in METHODS.values() if other.weighs_opacity)
        raise PointSplatError(
            f"opacity weight {opacity_weight:g}: {method.name} does not weigh opacity; leave it out, or choose one of "
            f"{weighing}"
        )


def need_usable(scene: Gaussians) -> None:
    """Make sure that a scene has something to keep.

    Raises:
        SceneError: if no Gaussian of it can be drawn.
    """
    if not bool(scene.usable().any()):
        raise SceneError(f"none of the {len(scene)} Gaussians can be drawn: all have NaN or infinite values")
