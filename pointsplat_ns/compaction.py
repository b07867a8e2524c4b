"""From what a person asks of a smaller scene to that scene: SH bands, then the count, by any method.

Poses are asked for only where they are needed: by a budget in dB, ``auto`` SH, an image-driven score, or
fine-tuning.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch

from pointsplat_ns.auto_budget import SH_PSNR, needed_sh_degree, smallest_within
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.fine_tune import fine_tune
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.image_scores import lightgaussian_score, pup_score
from pointsplat_ns.io.runs import open_run
from pointsplat_ns.poses import sample_views
from pointsplat_ns.pruning import (
    METHODS,
    SCORES,
    WEIGHTED,
    Keep,
    WithinPsnr,
    compact,
    cut_sh,
    energy_lost,
    need_usable,
    resolve_keep,
    select,
)
from pointsplat_ns.views import Views, views_of_run

IMAGE_SCORES: dict[str, Callable[..., torch.Tensor]] = {"lightgaussian": lightgaussian_score, "pup": pup_score}
"""Scores that look at the scene from poses; each takes the scene, the views and ``progress``."""

ALL_METHODS = (*METHODS, *IMAGE_SCORES)

COMPARED_VIEWS, COMPARED_SIDE = 12, 400
"""Views that renders are compared in, and their longer side in pixels: every count tried costs so many renders."""

SCORED_VIEWS = 40
"""Views that an image-driven score or fine-tuning looks from at most; the datasets here have up to 2,000."""


@dataclass(frozen=True, eq=False)
class Compaction:
    """A smaller scene and what was found on the way."""

    scene: Gaussians
    notes: tuple[str, ...]
    """Lines for a person: SH bands dropped, PSNR reached, where poses came from."""


class Poses:
    """The poses of a scene's dataset if it is a run whose data is at hand, poses sampled in its free space if not.

    Args:
        path: the scene's file or folder.
        dense: the scene.
    """

    def __init__(self, path: Path | str | None, dense: Gaussians):
        self._path, self._dense = path, dense
        self.origin = ""
        """Where they came from, once there are some."""
        self._missing = ""
        self._rasterize_mode: Literal["classic", "antialiased"] = "classic"

    @cached_property
    def _of_dataset(self) -> Views | None:
        if self._path is None or Path(self._path).suffix.lower() == ".ply":
            return None
        try:
            self._rasterize_mode = open_run(self._path, need_data=False).rasterize_mode
        except SceneError:
            return None  # a checkpoint that stands alone
        try:
            return views_of_run(self._path)
        except (SceneError, DataError) as error:
            self._missing = f" (no dataset: {error})"
            return None

    def __call__(self, count: int) -> Views:
        """At most ``count`` of the dataset's training poses, or ``count`` sampled ones; drawn as the run rendered.

        Raises:
            DataError: if there is no dataset, and no free place to look from.
        """
        if self._of_dataset is not None:
            self.origin = "poses of the dataset"
            return self._of_dataset.spread(count)
        views = sample_views(self._dense, count)
        self.origin = f"poses sampled in free space{self._missing}"
        return dataclasses.replace(views, rasterize_mode=self._rasterize_mode)


def compact_scene(
    dense: Gaussians,
    keep: Keep,
    by: str = "merge",
    sh: str = "all",
    opacity_weight: float | None = None,
    poses: Callable[[int], Views] | None = None,
    fine_tune_steps: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Compaction:
    """Make a scene smaller.

    Args:
        dense: N Gaussians.
        keep: ratio, count, size, or the PSNR that renders must reach against those of ``dense``.
        by: one of :data:`ALL_METHODS`.
        sh: "all" keeps the SH bands, a digit cuts them to that degree, "auto" to the lowest degree whose renders
            reach :data:`~pointsplat_ns.auto_budget.SH_PSNR` against those of ``dense``.
        opacity_weight: lambda of the scores that have one; by default the paper's.
        poses: gives so many views to look from; by default they are sampled in free space.
        fine_tune_steps: steps of optimising what was kept against the dense scene's own renders.
        progress: called with what is being done and the share done of it, in [0, 1].

    Raises:
        BudgetError: if no such scene can be made.
        SceneError: if no Gaussian of the scene can be drawn.
        DataError: if poses are needed and cannot be had.
        PointSplatError: if there is no such method.
    """
    if by not in ALL_METHODS:
        raise PointSplatError(f"no method is called {by!r}; expected one of {', '.join(ALL_METHODS)}")
    if not isinstance(keep, WithinPsnr):
        resolve_keep(len(dense), keep)  # before anything takes long
    need_usable(dense)
    poses = poses or Poses(None, dense)
    told = progress or (lambda what, share: None)
    notes: list[str] = []
    options = {} if opacity_weight is None or by not in WEIGHTED else {"opacity_weight": opacity_weight}
    full = _cut(dense, sh, poses, told, notes)
    reports = (lambda share: told(f"by {by}", share)) if by not in SCORES else None

    def make(count: int) -> Gaussians:
        if by not in IMAGE_SCORES:
            return compact(full, count, by, progress=None if auto else reports, **options)
        if "scores" not in known:
            told(f"by {by}", 0.0)
            known["scores"] = IMAGE_SCORES[by](full, poses(SCORED_VIEWS))
        return full[select(known["scores"], count)]

    known: dict[str, torch.Tensor] = {}
    auto = isinstance(keep, WithinPsnr)
    if auto:
        views = poses(COMPARED_VIEWS).resized(COMPARED_SIDE)
        found = smallest_within(dense, make, views, keep.value, lambda share: told("trying counts", share))
        scene = found.scene
        notes.append(
            f"renders reach {found.psnr:.1f} dB against the dense scene's, {found.worst:.1f} dB in the worst of "
        )
        notes[-1] += f"{len(views)} views; {len(found.tried)} counts tried"
    else:
        scene = make(resolve_keep(len(full), keep, full.sh_degree))
    if fine_tune_steps:
        views = poses(SCORED_VIEWS)
        scene = fine_tune(scene, views, dense, fine_tune_steps, progress=lambda share: told("fine-tuning", share))
        notes.append(f"fine-tuned {fine_tune_steps} steps against the dense scene's renders in {len(views)} views")
    origin = getattr(poses, "origin", "")
    return Compaction(scene, (*notes, origin) if origin else tuple(notes))


def _cut(dense: Gaussians, sh: str, poses, told, notes: list[str]) -> Gaussians:
    """The scene with the SH bands that are asked for."""
    if sh == "all":
        return dense
    if sh == "auto":
        told("comparing SH degrees", 0.0)
        degree, psnr = needed_sh_degree(dense, poses(COMPARED_VIEWS).resized(COMPARED_SIDE), SH_PSNR)
        reached = f"; renders reach {psnr:.1f} dB against all bands" if math.isfinite(psnr) else ""
    elif sh in ("0", "1", "2", "3"):
        degree, reached = int(sh), ""
    else:
        raise PointSplatError(f"sh is {sh!r}; expected all, auto or a degree from 0 to 3")
    if degree >= dense.sh_degree:
        notes.append(f"SH degree {dense.sh_degree} kept, no band dropped")
        return dense
    lost = 100 * energy_lost(dense, degree)
    notes.append(f"SH degree {dense.sh_degree} cut to {degree}: {lost:.0f} % of the directional energy lost{reached}")
    return cut_sh(dense, degree)
