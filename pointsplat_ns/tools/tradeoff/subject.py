"""A scene to be measured, and how the scene of a setting is made: like its command."""

from __future__ import annotations

import functools
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos, view_source
from pointsplat_ns.pipeline.compact import compact_scene
from pointsplat_ns.pipeline.options import CompactRequest, PruneRequest, RepairBudget
from pointsplat_ns.pipeline.photos.examples import Photos
from pointsplat_ns.pipeline.photos.posed_photos import read_with_photos
from pointsplat_ns.pipeline.photos.posed_scene import (
    NO_POSES,
    check_photos,
    read_found,
    without_poses,
)
from pointsplat_ns.pipeline.prune import prune_scene
from pointsplat_ns.pipeline.view_provider import ViewSource
from pointsplat_ns.rendering.comparison.sizes import parse_resolution, size_text
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import may_be_run, name_of
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tools.tradeoff.points import DENSE, EFFORTS, Setting
from pointsplat_ns.view_sampling.upright import up_named


@dataclass(frozen=True, eq=False)
class Subject:
    """The scene of a measurement."""

    dense: Gaussians
    path: Path
    new_views: Callable[[], ViewSource]
    """Makes a new source of its views, the same as for its commands."""
    held_out: Callable[[], Photos] | None = None
    """Reads its held-out photos; None if it cannot have any."""
    training: Photos | None = None
    """Its training photos, for the repair ``photos``."""
    words: tuple[str, ...] = ()
    """Options of its commands on views, such as ``--poses FILE``."""
    resolution: tuple[int, int] | None = None
    """Width and height of pictures in pixels, if given; ``new_views`` has them too."""
    photos: Path | None = None
    """Folder of its photos, if they are not those of its run."""

    def names(self, setting: Setting) -> dict[str, Any]:
        """The key, the label and the command of a setting's point. The command has the count,
        because percentages are rounded."""
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
            trained = (
                "trained on photos"
                if setting.repair == "photos"
                else f"repaired ({setting.repair})"
            )
            key = f"{key}_{setting.repair}"
            label = f"{label}, {trained}"
            command = "compact"
            options += ["--effort", EFFORTS[setting.repair]]
        if setting.repair == "photos":
            options += ["--photos", *([] if self.photos is None else [str(self.photos)])]
        words = [
            "pointsplat",
            command,
            str(self.path),
            *options,
            "-o",
            f"{name_of(self.path)}_{key}.ply",
        ]
        return {"key": key, "label": label, "command": shlex.join(words)}


def subject_at(
    path: Path,
    poses: str | Path | None,
    resolution: tuple[int, int] | str | None,
    up: str | None,
    data: str | Path | None,
    photos: Path | None,
    progress: Progress,
    training: bool,
) -> Subject:
    """The scene at a path, with the options on views that its commands repeat; ``photos`` is a
    folder of photos. With ``training``, photos are also trained on. Raises a PointSplatError if
    there are none."""
    size = parse_resolution(resolution)
    upward = up_named(up)
    sampled = without_poses(poses)
    held_out: Callable[[], Photos] | None = None
    trained: Photos | None = None
    run = None if sampled or photos is not None else path
    if photos is None:
        dense, given, file = read_found(path, poses)
        if run is not None and given is None and may_be_run(run):
            held_out = functools.partial(run_photos, run, "test", data)
        if training:
            trained = run_photos(path, "train", data)
            check_photos(dense, trained, str(path))
    else:
        dense, posed = read_with_photos(path, photos, poses, data, size, progress, training)
        given = posed.views
        file = posed.poses
        trained = posed.training
        held_out = lambda: posed.held_out  # noqa: E731
    named = {
        "--poses": NO_POSES if sampled else file,
        "--resolution": None if size is None else size_text(size),
        "--data": data,
    }
    words = [
        word
        for option, value in named.items()
        if value is not None
        for word in (option, str(value))
    ]
    words += [] if up is None else [f"--up={up}"]
    new_views = functools.partial(view_source, dense, given, run, data, size, upward)
    return Subject(dense, path, new_views, held_out, trained, tuple(words), size, photos)


def make(subject: Subject, setting: Setting, progress: Progress) -> tuple[Gaussians, float]:
    """The scene of a setting, and the seconds that it took: from a new source of views, so that
    time and result equal the command's. Raises KeyboardInterrupt on Ctrl-C, also during a
    repair."""
    dense = subject.dense
    views = subject.new_views()
    start = time.perf_counter()
    if setting.repair == "none":
        scene = prune_scene(dense, PruneRequest(setting.count, setting.by), views, progress).scene
    else:
        budget = RepairBudget(EFFORTS[setting.repair])
        request = CompactRequest.of(
            None, setting.count, setting.by, repair=budget, photos=setting.repair == "photos"
        )
        compacted = compact_scene(dense, request, views, progress, subject.training)
        if compacted.interrupted:
            raise KeyboardInterrupt
        scene = compacted.scene
    return scene.to(dense.device), time.perf_counter() - start
