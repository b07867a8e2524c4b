"""The registry of pruning methods, and :func:`prune`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError, DataError, PointSplatError, SceneError
from pointsplat_ns.pruning.baselines import (
    authors_score,
    coverage_score,
    opacity_score,
    random_score,
)
from pointsplat_ns.pruning.budget import Keep, resolve_keep
from pointsplat_ns.pruning.merging import merge
from pointsplat_ns.pruning.paper import paper_score, select
from pointsplat_ns.pruning.view_scores import lightgaussian_score, pup_score
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.sampler import Sampler


@dataclass(frozen=True)
class Method:
    """A pruning method."""

    name: str
    score: Callable[..., Tensor] | None
    """Function from a scene (and views, if needed) to scores (N,), of which the highest are kept;
    None for merging."""
    needs_views: bool = False
    """Whether the score needs views."""
    weighs_opacity: bool = False
    """Whether the score takes ``opacity_weight``."""


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("merge", None),
        Method("coverage", coverage_score),
        Method("paper", paper_score, weighs_opacity=True),
        Method("authors", authors_score, weighs_opacity=True),
        Method("opacity", opacity_score),
        Method("random", random_score),
        Method("lightgaussian", lightgaussian_score, needs_views=True),
        Method("pup", pup_score, needs_views=True),
    )
}
"""All methods by name, best first."""


def method_named(by: str, opacity_weight: float | None = None) -> Method:
    """The method called ``by``. Raises PointSplatError if it is unknown, or gets an opacity weight
    that it does not use."""
    if by not in METHODS:
        raise PointSplatError(f"no method is called {by!r}; expected one of {', '.join(METHODS)}")
    if opacity_weight is not None and not METHODS[by].weighs_opacity:
        weighing = ", ".join(other.name for other in METHODS.values() if other.weighs_opacity)
        raise PointSplatError(
            f"opacity weight {opacity_weight:g}: {by} does not weigh opacity; leave it out, or "
            f"choose one of {weighing}"
        )
    return METHODS[by]


@dataclass(frozen=True)
class PruneSettings:
    """Pruning settings for many scenes, as in training. Raises BudgetError if ``keep`` is neither a
    ratio nor a count, and PointSplatError if the method needs views, or as
    :func:`method_named`."""

    keep: float | int
    """Ratio (float, at most 1) or count (int)."""
    by: str = "merge"
    opacity_weight: float | None = None
    """Lambda of the methods that weigh opacity; None for the paper's value."""

    def __post_init__(self) -> None:
        keep = self.keep
        if not 0 < keep < math.inf or (keep > 1 and keep != int(keep)):  # NaN fails too
            raise BudgetError(
                f"keep is {keep:g}; expected a ratio above 0 and up to 1 (such as 0.3) or a whole "
                "number of Gaussians (such as 50000)"
            )
        if keep > 1:  # configuration files have floats for counts
            object.__setattr__(self, "keep", int(keep))
        if method_named(self.by, self.opacity_weight).needs_views:
            raise PointSplatError(
                f"{self.by} needs views of the scene; expected a method that needs none"
            )

    def prune(self, scene: Gaussians, progress: Callable[[float], None] | None = None) -> Gaussians:
        """Prune a scene with these settings; see :func:`prune`."""
        return prune(
            scene, self.keep, self.by, opacity_weight=self.opacity_weight, progress=progress
        )


def prune(
    scene: Gaussians,
    keep: Keep | str,
    by: str = "merge",
    views: Views | Sampler | None = None,
    opacity_weight: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Gaussians:
    """Prune a scene to a number of Gaussians.

    Args:
        scene: N Gaussians.
        keep: ratio, count or size (see :func:`~pointsplat_ns.pruning.budget.resolve_keep`).
        by: one of :data:`METHODS`. Methods with a score keep Gaussians unchanged, in their original
            order.
        views: for methods that need them. Merging uses views or a sampler; for None it samples its
            own.
        opacity_weight: lambda of the methods that weigh opacity; by default the paper's.
        progress: called with the share done, in [0, 1].

    Returns:
        Exactly the number of Gaussians that ``keep`` resolves to.

    Raises:
        BudgetError: if ``keep`` is out of range for the scene.
        SceneError: if no Gaussian of the scene can be drawn.
        DataError: if the method needs views and none are given.
        PointSplatError: if the method is unknown, or gets an opacity weight that it does not use.
    """
    method = method_named(by, opacity_weight)
    count = resolve_keep(len(scene), keep, scene.sh_degree, scene.traits)
    need_usable(scene)
    if method.score is None:
        return merge(scene, count, progress, views).scene
    given = None if isinstance(views, Sampler) else views
    return scene[select(score_of(scene, method, given, opacity_weight, progress), count)]


@torch.no_grad()
def score_of(
    scene: Gaussians,
    method: Method,
    views: Views | Callable[[], Views] | None = None,
    opacity_weight: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Tensor:
    """Scores (N,) float64 of a scene by a method with a score; arguments as for :func:`prune`.
    ``views`` may be a function that returns them."""
    assert method.score is not None, f"{method.name} has no score"
    if method.needs_views:
        if views is None:
            raise DataError(f"{method.name} needs views of the scene; expected views")
        return method.score(scene, views() if callable(views) else views, progress=progress)
    if opacity_weight is not None:
        return method.score(scene, opacity_weight=opacity_weight)
    return method.score(scene)


def need_usable(scene: Gaussians) -> None:
    """Raise a SceneError if no Gaussian of a scene can be drawn."""
    if len(scene) == 0:
        raise SceneError("the scene holds no Gaussians that can be drawn")
    if not bool(scene.usable().any()):
        raise SceneError(
            f"none of the {len(scene)} Gaussians can be drawn: all have NaN or infinite values"
        )
