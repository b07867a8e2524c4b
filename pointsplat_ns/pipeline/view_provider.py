"""Provides the views of a scene: given views, the poses of its dataset, or sampled poses."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import count as counted
from pathlib import Path

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.pipeline.run_data import run_data
from pointsplat_ns.rendering.comparison.sizes import (
    RESOLUTION,
    SMALLEST_SIDE,
    middle_sized,
    several_sizes,
)
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import may_be_run, open_run
from pointsplat_ns.scene.views import View, Views, spread_indices
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.upright import Up


@dataclass(frozen=True)
class ViewCounts:
    """Maximum numbers of views per purpose. Datasets may have thousands."""

    weighed: int = 48
    """Known views for the visibility weights of merging."""
    compared: int = 12
    """Views in which renders are compared."""
    stepped: int = 96
    """Sampled views for the steps of a repair of few Gaussians."""
    scored: int = 40
    """Views for methods that score in views."""
    opening: int = 24
    """Known views from which the views of a page are chosen."""
    walked: int = 12
    """Views along the camera path of a film."""


VIEW_COUNTS = ViewCounts()


class Origin(Enum):
    """Kind of source of views."""

    GIVEN = "given"
    DATASET = "dataset"
    SAMPLED = "sampled"


@dataclass(frozen=True)
class ViewOrigin:
    """Origin of the views of a scene."""

    kind: Origin
    up: Up | None = None
    """Up direction of sampled views."""
    missing: str = ""
    """Error of reading poses from the run's dataset; empty if there was none, or no run."""


class ViewProvider:
    """Views of a scene, read or sampled on first use (a budget in Gaussians needs none).

    Args:
        scene: the scene that the views are for.
        given: known views; they take precedence over ``run``.
        run: file or folder of the scene. If it belongs to a run whose dataset can be read, views
            are its training poses.
        data: folder of the run's data, if it has moved.
        resolution: width and height at which people view the scene, pixels. By default given views
            and photos keep their size, and sampled views have 1920 x 1080.
        up: up direction for sampled views; by default declared by the scene, or estimated.
    """

    def __init__(
        self,
        scene: Gaussians,
        given: Views | None = None,
        run: Path | str | None = None,
        data: Path | str | None = None,
        resolution: tuple[int, int] | None = None,
        up: Up | None = None,
    ):
        self._scene = scene
        self._given = given
        self._run = run
        self._data = data
        self._resolution = resolution
        self._up = up
        self.origin: ViewOrigin | None = None
        """Origin of the views; None before first use."""
        self.missing = ""
        """Error of reading poses from the run's dataset; empty if there was none."""

    @property
    def given(self) -> Views | None:
        """Given views; None if there are none."""
        return self._given if self._given is not None and len(self._given) else None

    @cached_property
    def _of_dataset(self) -> Views | None:
        if self._run is None or not may_be_run(self._run):
            return None
        try:
            open_run(self._run, need_data=False)
        except SceneError:
            return None  # a checkpoint outside a run
        try:
            return run_data().views(self._run, "train", self._data)
        except (SceneError, DataError) as error:
            self.missing = str(error)
            return None

    @property
    def _known(self) -> Views | None:
        """All known views; None if there are none."""
        return self._of_dataset if self.given is None else self.given

    def known(self, count: int) -> Views | None:
        """At most ``count`` known views: given views, or the dataset's training poses; None if
        there are none."""
        if self._known is None:
            return None
        self.origin = ViewOrigin(Origin.DATASET if self.given is None else Origin.GIVEN)
        return self._at_resolution(self._known.spread(count))

    def views(self, count: int) -> Views:
        """At most ``count`` known views, or as many sampled ones.

        Raises:
            DataError: if the given views are empty, or none can be sampled.
        """
        if self._given is not None and self.given is None:
            raise DataError("the views given are empty; expected at least one view")
        views = self.known(count)
        if views is None:
            views = self.sampler.views(count)
            self.origin = ViewOrigin(Origin.SAMPLED, self.sampler.up, self.missing)
        return views

    @cached_property
    def sampler(self) -> Sampler:
        """The sampler of the scene."""
        return Sampler(self._scene, self._resolution or RESOLUTION, self._up)

    def for_merging(self) -> Views | Sampler:
        """At most ``VIEW_COUNTS.weighed`` known views; the sampler if there are none."""
        return self.known(VIEW_COUNTS.weighed) or self.sampler

    def _at_resolution(self, views: Views) -> Views:
        """Views resized to the longer side of the requested resolution, if any."""
        return views if self._resolution is None else views.resized(max(self._resolution))

    def whole(self) -> Views:
        """At most ``VIEW_COUNTS.compared`` views in which renders are compared, at full size."""
        return self._whole

    @cached_property
    def _whole(self) -> Views:
        return self.views(VIEW_COUNTS.compared)

    def compared(self) -> Views:
        """The views in which renders are compared, at
        :func:`~pointsplat_ns.rendering.comparison.sizes.middle_sized` size."""
        return middle_sized(self._whole)

    def scored(self, count: int) -> Views:
        """At most ``count`` views for scores, at the size of :meth:`compared`."""
        return middle_sized(self.views(count))

    def others(
        self, seed: int = 0, count: int = VIEW_COUNTS.stepped, drawn_side: int = SMALLEST_SIDE
    ) -> Iterator[View]:
        """Views to optimise on, endless, without those of :meth:`compared`. Every round shuffles
        them anew. A view is subsampled from a picture of one of
        :func:`~pointsplat_ns.rendering.comparison.sizes.several_sizes`, in the next round of
        another size.

        They are known views if more are left than compared; with fewer, known and sampled views
        alternate; with none, all are sampled.

        Args:
            seed: seed of the order, and of sampled views.
            count: number of distinct sampled views.
            drawn_side: longer side of the subsampled picture, pixels.

        Raises:
            DataError: if no view can be sampled.
        """
        known = self._known
        compared = self.compared()
        known_count = 0 if known is None else len(known)
        taken = spread_indices(known_count, VIEW_COUNTS.compared)
        left = sorted(set(range(known_count)) - set(taken))
        if known is None or not left:
            yield from self.sampled(seed, count, drawn_side)
            return
        others = _shuffled(self._at_resolution(known)[left], seed, drawn_side)
        if len(left) > len(compared):
            yield from others
        else:
            sampled = self.sampled(seed, count, drawn_side)
            for pair in zip(others, sampled, strict=False):  # both are endless
                yield from pair

    def sampled(
        self, seed: int = 0, count: int = VIEW_COUNTS.stepped, drawn_side: int = SMALLEST_SIDE
    ) -> Iterator[View]:
        """Sampled views, endless, ordered and sized as in :meth:`others`, which documents the
        arguments."""
        compared = self.compared()
        views = self.sampler.views(count, seed + 1)
        views = replace(
            views, background=compared.background, rasterize_mode=compared.rasterize_mode
        )
        for turn, view in enumerate(_shuffled(views, seed, drawn_side)):
            opposite = self._known is None and turn % 5 == 4  # the viewer's background is unknown
            yield replace(view, background=1 - view.background) if opposite else view


def _shuffled(views: Views, seed: int, drawn_side: int) -> Iterator[View]:
    """Views in random order, endless. Every round shuffles them anew and changes their sizes. A
    repeated view of the same size is the same object."""
    sizes = [[*of_size] for of_size in several_sizes(views, drawn_side)]
    generator = random.Random(seed)
    for lap in counted():
        for index in generator.sample(range(len(views)), len(views)):
            yield sizes[(lap + index) % len(sizes)][index]
