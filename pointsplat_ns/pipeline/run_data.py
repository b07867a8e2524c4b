"""Finds the photos and poses of a trained run.

The package itself does not read the datasets of runs. A plugin does, such as the nerfstudio plugin.
It registers itself as an entry point of the group ``pointsplat_ns.run_data``, and is loaded on
first use.
"""

from __future__ import annotations

import functools
import importlib.metadata
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from pointsplat_ns.errors import DataError

if TYPE_CHECKING:
    from pointsplat_ns.pipeline.photos.examples import Photos
    from pointsplat_ns.scene.views import Views

GROUP = "pointsplat_ns.run_data"
"""Group of entry points."""

Split = Literal["train", "test"]


class RunData(Protocol):
    """Reads the dataset of a run, given by its folder, ``config.yml`` or checkpoint. ``data`` is
    the new place of a dataset that has moved: the dataset itself, or a folder above it."""

    def views(self, run: Path | str, split: Split, data: Path | str | None) -> Views:
        """The poses of a split, in the frame of the trained scene, on the CPU. Raises SceneError if
        there is no run, DataError if its poses are not usable."""

    def photos(self, run: Path | str, split: Split, data: Path | str | None) -> Photos:
        """The photos of a split, read lazily. Raises the errors of :meth:`views`."""

    def check_named(self, run: object, data: Path | str) -> None:
        """Raise a PointSplatError if ``run`` is not the path of a run, its poses cannot be read
        from ``data``, or renders of its scene do not match the photos there."""


@functools.cache
def run_data() -> RunData:
    """The registered reader. Raises DataError if no plugin is installed."""
    for entry in importlib.metadata.entry_points(group=GROUP):
        return entry.load()
    raise DataError(
        "reading the photos and poses of a run needs the nerfstudio plugin; install the package "
        "again: pip install 'pointsplat-ns[nerfstudio]'"
    )
