"""The source of a scene's views: given views, the poses of its dataset, or poses sampled in free space."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.runs import open_run
from pointsplat_ns.pruning.view_sampling import sample_views
from pointsplat_ns.views import RasterizeMode, Views

COMPARED_VIEWS, COMPARED_SIDE = 12, 400
"""Maximum number of views that renders are compared in, and maximum of their longer side in pixels."""


class ViewSource:
    """Views of a scene, looked up or sampled when they are first needed (a budget in Gaussians needs none).

    Args:
        scene: the scene that the views are for.
        given: views to use; ``run`` and ``dataset_views`` are then ignored.
        run: the file or folder that the scene was read from. If it is a run whose data is found, its training poses
            are used.
        dataset_views: function that reads the poses of a run's dataset.
    """

    def __init__(
        self,
        scene: Gaussians,
        given: Views | None = None,
        run: Path | str | None = None,
        dataset_views: Callable[[Path | str], Views] | None = None,
    ):
        self._scene, self._given, self._run, self._dataset_views = scene, given, run, dataset_views
        self.origin = ""
        """Text that says where views came from; empty until there are some."""
        self._missing = ""
        self._rasterize_mode: RasterizeMode = "classic"

    @property
    def given(self) -> Views | None:
        """The views that were given, if any."""
        return self._given if self._given is not None and len(self._given) else None

    @cached_property
    def _of_dataset(self) -> Views | None:
        if self._run is None or self._dataset_views is None or Path(self._run).suffix.lower() == ".ply":
            return None
        try:
            self._rasterize_mode = open_run(self._run, need_data=False).rasterize_mode
        except SceneError:
            return None  # a checkpoint outside a run
        try:
            return self._dataset_views(self._run)
        except (SceneError, DataError) as error:
            self._missing = f" (no dataset: {error})"
            return None

    def views(self, count: int) -> Views:
        """At most ``count`` views: given ones, those of the dataset's training poses, or sampled ones, which get the
        run's rasterize mode.

        Raises:
            DataError: if the given views are empty, or none can be sampled.
        """
        if self._given is not None:
            if len(self._given) == 0:
                raise DataError("the views given are empty; expected at least one view")
            self.origin = "given views"
            return self._given.spread(count)
        if self._of_dataset is not None:
            self.origin = "poses of the dataset"
            return self._of_dataset.spread(count)
        views = sample_views(self._scene, count)
        self.origin = f"poses sampled in free space{self._missing}"
        return dataclasses.replace(views, rasterize_mode=self._rasterize_mode)

    def compared(self) -> Views:
        """The views that renders are compared in: at most 12, with a longer side of at most 400 pixels."""
        return self.views(COMPARED_VIEWS).resized(COMPARED_SIDE)
