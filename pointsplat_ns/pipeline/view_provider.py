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
    """Maximum numbers of views for what is decided by views. Datasets may have thousands."""

    weighed: int = 48
    """Known views from which merging computes visibility weights."""
    compared: int = 12
    """Views in which renders are compared."""
    stepped: int = 96
    """Sampled views for the steps of repairs of few Gaussians."""
    scored: int = 40
    """Views for methods that score by views."""
    opening: int = 24
    """Known views from which those of a page are chosen."""
    walked: int = 12
    """Views that a walk passes."""


VIEW_COUNTS = ViewCounts()


class Origin(Enum):
    """Where views come from."""

    GIVEN = "given"
    DATASET = "dataset"
    SAMPLED = "sampled"


@dataclass(frozen=True)
class ViewOrigin:
    """Where the views of a scene came from."""

    kind: Origin
    up: Up | None = None
    """The axis that is up, of sampled views."""
    missing: str = ""
    """Why the dataset of the scene's run gives no poses; empty if it does, or there is no run."""


class ViewProvider:
    """Views of a scene, looked up or sampled when they are first needed (a budget in Gaussians
    needs none).

    Args:
        scene: the scene that the views are for.
        given: views to use; ``run`` is then ignored.
        run: the file or folder that the scene was read from. If it is a run whose data is found,
            its training poses are used.
        data: where the run's data is now, if it moved.
        resolution: width and height, pixels, of the pictures that people look at. By default given
            views and photos have their own, and sampled views 1920 x 1080.
        up: which way is up, for sampled views; by default what the scene declares, or estimated.
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
        """Where views came from; None until there are some."""
        self.missing = ""
        """Why a run's dataset gives no poses; empty if it does, or was not looked for."""

    @property
    def given(self) -> Views | None:
        """The views that were given, if any."""
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
        """All known views."""
        return self._of_dataset if self.given is None else self.given

    def known(self, count: int) -> Views | None:
        """At most ``count`` known views: given ones, or those of the dataset's training poses; None
        if there are none."""
        if self._known is None:
            return None
        self.origin = ViewOrigin(Origin.DATASET if self.given is None else Origin.GIVEN)
        return self._at_resolution(self._known.spread(count))

    def views(self, count: int) -> Views:
        """At most ``count`` known views, or sampled ones.

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
        """At most :data:`VIEW_COUNTS.weighed` known views; the sampler if there are none."""
        return self.known(VIEW_COUNTS.weighed) or self.sampler

    def _at_resolution(self, views: Views) -> Views:
        """Views with the longer side of the resolution, if one was asked for."""
        return views if self._resolution is None else views.resized(max(self._resolution))

    def whole(self) -> Views:
        """The views in which renders are compared, at their full size: at most
        ``VIEW_COUNTS.compared``."""
        return self._whole

    @cached_property
    def _whole(self) -> Views:
        return self.views(VIEW_COUNTS.compared)

    def compared(self) -> Views:
        """The views in which renders are compared, at
        :func:`~pointsplat_ns.rendering.comparison.sizes.middle_sized` size."""
        return middle_sized(self._whole)

    def scored(self, count: int) -> Views:
        """At most ``count`` views for scores, of the size of :meth:`compared`."""
        return middle_sized(self.views(count))

    def others(
        self, seed: int = 0, count: int = VIEW_COUNTS.stepped, drawn_side: int = SMALLEST_SIDE
    ) -> Iterator[View]:
        """Views to optimise on, without end: none of the :meth:`compared` ones, in random order,
        each once before any is repeated. Each is subsampled from a picture of one of
        :func:`~pointsplat_ns.rendering.comparison.sizes.several_sizes`, the next time of another.

        They are known views; if these are fewer than the compared ones, known and sampled ones in
        turn; if all known ones are compared, or there are none, sampled ones.

        Args:
            seed: seed of the order, and of sampled views.
            count: number of different sampled views.
            drawn_side: longer side of what is drawn of a picture, pixels.

        Raises:
            DataError: if none can be sampled.
        """
        known = self._known
        compared = self.compared()
        every = 0 if known is None else len(known)
        left = sorted(set(range(every)) - set(spread_indices(every, VIEW_COUNTS.compared)))
        if known is None or not left:
            yield from self.sampled(seed, count, drawn_side)
            return
        others = _shuffled(self._at_resolution(known)[left], seed, drawn_side)
        if len(left) > len(compared):
            yield from others
        else:
            for pair in zip(
                others, self.sampled(seed, count, drawn_side), strict=False
            ):  # neither ends
                yield from pair

    def sampled(
        self, seed: int = 0, count: int = VIEW_COUNTS.stepped, drawn_side: int = SMALLEST_SIDE
    ) -> Iterator[View]:
        """Sampled views without end, in the order and of the sizes of :meth:`others`, which has the
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
    """Views in random order, each once before any is repeated, then of another size; without end. A
    view that comes again is the same object."""
    sizes = [[*of_size] for of_size in several_sizes(views, drawn_side)]
    generator = random.Random(seed)
    for lap in counted():
        for index in generator.sample(range(len(views)), len(views)):
            yield sizes[(lap + index) % len(sizes)][index]
