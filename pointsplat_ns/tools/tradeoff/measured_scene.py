"""A scene to measure, and the smaller scenes of its settings, made as by their commands."""

from __future__ import annotations

import functools
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pointsplat_ns.pipeline.compact_scene import compact_scene
from pointsplat_ns.pipeline.options import NO_POSES, CompactOptions, PruneOptions, ViewOptions
from pointsplat_ns.pipeline.photos.examples import Photos
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.run_data import run_data
from pointsplat_ns.pipeline.subject import read_subject
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering.comparison.sizes import size_text
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import may_be_run, name_of
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tools.tradeoff.points import DENSE, EFFORTS, Setting


@dataclass(frozen=True, eq=False)
class Subject:
    """The scene of a measurement."""

    dense: Gaussians
    path: Path
    new_views: Callable[[], ViewProvider]
    """Makes a new source of views, as its commands do."""
    held_out: Callable[[], Photos] | None = None
    """Reads the held-out photos; None if there cannot be any."""
    training: Photos | None = None
    """Training photos, for the repair ``photos``."""
    words: tuple[str, ...] = ()
    """Options on views for its commands, such as ``--poses FILE``."""
    resolution: tuple[int, int] | None = None
    """Width and height of pictures, pixels, if given; also those of ``new_views``."""
    photos: Path | None = None
    """Folder of photos, unless they belong to the run."""

    def names(self, setting: Setting) -> dict[str, Any]:
        """Key, label and command of a setting's point. The command has the count, because
        percentages are rounded."""
        if setting.by == DENSE:
            return {"key": DENSE, "label": DENSE, "command": ""}
        percent = 100 * setting.count / len(self.dense)
        key = f"{percent:.4g}pct"
        label = f"{percent:.3g} %"
        command = "prune"
        options = ["--keep", str(setting.count), *self.words]
        if setting.by != "merge":
            key = f"{key}_{setting.by}"
            label = f"{label} by {setting.by}"
            options += ["--by", setting.by]
        if setting.repair != "none":
            on_photos = setting.repair == "photos"
            repaired = "trained on photos" if on_photos else f"repaired ({setting.repair})"
            key = f"{key}_{setting.repair}"
            label = f"{label}, {repaired}"
            command = "compact"
            options += ["--effort", EFFORTS[setting.repair]]
        if setting.repair == "photos":
            options += ["--photos", *([] if self.photos is None else [str(self.photos)])]
        output = f"{name_of(self.path)}_{key}.ply"
        words = ["pointsplat", command, str(self.path), *options, "-o", output]
        return {"key": key, "label": label, "command": shlex.join(words)}


def subject_at(
    path: Path,
    options: ViewOptions,
    photos: Path | None,
    progress: Progress,
    training: bool,
) -> Subject:
    """Read the scene at a path, with the options on views that its commands repeat. ``photos`` is a
    folder of photos. With ``training``, training photos are read too. Raises a PointSplatError if
    there are none."""
    options.check()
    folder_or_run: Path | bool = training if photos is None else photos
    read = read_subject(path, options, photos=folder_or_run, training=training, progress=progress)
    held_out: Callable[[], Photos] | None = None
    if photos is not None:
        held_out = lambda: read.held_out  # noqa: E731
    elif not options.sampled and read.given is None and may_be_run(path):
        held_out = functools.partial(run_data().photos, path, "test", options.data)
    named = {
        "--poses": NO_POSES if options.sampled else read.poses,
        "--resolution": None if options.size is None else size_text(options.size),
        "--data": options.data,
    }
    words = [
        word
        for option, value in named.items()
        if value is not None
        for word in (option, str(value))
    ]
    words += [] if options.up is None else [f"--up={options.up}"]
    return Subject(
        dense=read.dense,
        path=path,
        new_views=read.views,
        held_out=held_out,
        training=read.training,
        words=tuple(words),
        resolution=options.size,
        photos=photos,
    )


def make(subject: Subject, setting: Setting, progress: Progress) -> tuple[Gaussians, float]:
    """Make the scene of a setting, and measure the duration in seconds. A new source of views makes
    time and result equal to the command's. Raises KeyboardInterrupt on Ctrl-C, also during a
    repair."""
    dense = subject.dense
    views = subject.new_views()
    start = time.perf_counter()
    if setting.repair == "none":
        options = PruneOptions(keep=setting.count, by=setting.by)
        scene = prune_scene(dense, options, views, progress).scene
    else:
        compact_options = CompactOptions(
            keep=setting.count,
            by=setting.by,
            effort=EFFORTS[setting.repair],
            photos=setting.repair == "photos",
        ).completed()
        compacted = compact_scene(dense, compact_options, views, progress, subject.training)
        if compacted.interrupted:
            raise KeyboardInterrupt
        scene = compacted.scene
    return scene.to(dense.device), time.perf_counter() - start
