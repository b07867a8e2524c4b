"""A scene to be measured, the settings to measure, and how the scene of a setting is made: like its command."""

from __future__ import annotations

import functools
import itertools
import math
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pointsplat_ns.compression.compact import compact_scene
from pointsplat_ns.compression.compacted import Compacted
from pointsplat_ns.compression.photo_repair import Photos
from pointsplat_ns.compression.posed_photos import read_with_photos
from pointsplat_ns.compression.posed_scene import NO_POSES, read_found, without_poses
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.requests import CompactRequest, PruneRequest, RepairBudget
from pointsplat_ns.compression.trained_refiner import SHIPPED, TrainedRefiner, load_refiner
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.runs import may_be_run, name_of
from pointsplat_ns.looking.sizes import parse_resolution, size_text
from pointsplat_ns.looking.upright import Up, up_named
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos, view_source
from pointsplat_ns.pruning import Keep, method_named, parse_keep, resolve_keep
from pointsplat_ns.system.memory import PeakMemory
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.tradeoff.points import DENSE, EFFORTS, REPAIRS, Repair, Setting
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Subject:
    """The scene of a measurement."""

    dense: Gaussians
    path: Path
    """Path of the scene in commands."""
    name: str
    """Name of the scene in files of commands."""
    new_views: Callable[[], ViewSource]
    """Makes a new source of its views, the same as for its commands."""
    held_out: Callable[[], Photos] | None = None
    """Reads its held-out photos; None if it cannot have any."""
    refiner: TrainedRefiner | None = None
    """The refiner before repairs. None is no refiner, but the shipped one for the repair ``refiner``."""
    suffix: str = ".ply"
    """Suffix of the format of smaller scenes."""
    words: tuple[str, ...] = ()
    """Options of its commands on views, such as ``--poses FILE``."""
    resolution: tuple[int, int] | None = None
    """Width and height of pictures in pixels, if given; ``new_views`` has them too."""
    training: Photos | None = None
    """Its training photos, for the repair ``photos``."""
    photos: Path | None = None
    """Folder of its photos, if they are not those of its run."""

    def names(self, setting: Setting) -> dict[str, Any]:
        """The key, the label and the command of a setting's point. The command has the count, because percentages are
        rounded."""
        if setting.by == DENSE:
            return {"key": DENSE, "label": DENSE, "command": ""}
        percent, cut = 100 * setting.count / len(self.dense), setting.sh_degree != self.dense.sh_degree
        merged, repaired = setting.by == "merge", setting.repair != "none"
        keys = [f"{percent:.4g}pct", f"sh{setting.sh_degree}"]
        keys += [setting.repair] * repaired + [setting.by] * (not merged)
        labels = [f"{percent:.3g} %" + ("" if merged else f" by {setting.by}")]
        labels += [f"SH degree {setting.sh_degree}"] * cut
        named = {"none": [], "refiner": ["refined"], "photos": ["trained on photos"]}
        labels += named.get(setting.repair, [f"repaired ({setting.repair})"])
        words = ["pointsplat", "compact" if repaired else "prune", str(self.path), "--keep", str(setting.count)]
        words += [*self.words, *(["--by", setting.by] if repaired or not merged else [])]
        words += ["--sh", str(setting.sh_degree)] if cut else []
        words += ["--refiner", SHIPPED] if setting.repair == "refiner" else []
        words += ["--effort", EFFORTS[setting.repair]] if repaired else []
        words += ["--photos"] if setting.repair == "photos" else []
        words += [str(self.photos)] if setting.repair == "photos" and self.photos is not None else []
        key = "_".join(keys)
        command = shlex.join([*words, "-o", f"{self.name}_{key}.ply"])
        return {"key": key, "label": ", ".join(labels), "command": command}


def subject_of(
    dense: Gaussians,
    run: Path | None,
    views: Views | None = None,
    refiner: TrainedRefiner | None = None,
    suffix: str = ".ply",
    resolution: tuple[int, int] | None = None,
    up: Up | None = None,
    data: str | Path | None = None,
) -> Subject:
    """A scene to be measured, with the views that its commands have and its held-out photos.

    Args:
        dense: the scene.
        run: the file or folder whose dataset may have the poses and photos; None if it is in memory only, or views are
            to be sampled.
        views: given ones, in place of any others; there are no photos of them.
        refiner: what repairs begin with; by default nothing, and the one that ships where it repairs alone.
        suffix: of the format that smaller scenes are written in.
        resolution, up: as for :class:`~pointsplat_ns.looking.view_source.ViewSource`.
        data: where the data of the run is now, if it moved.
    """
    held_out = None
    if run is not None and views is None and may_be_run(run):
        held_out = functools.partial(run_photos, run, "test", data)
    return Subject(
        dense, run or Path("scene.ply"), "scene", lambda: view_source(dense, views, run, data, resolution, up),
        held_out, refiner, suffix, resolution=resolution,
    )  # fmt: skip


def subject_at(
    path: Path,
    poses: str | Path | None,
    resolution: tuple[int, int] | str | None,
    up: str | None,
    data: str | Path | None,
    photos: Path | None = None,
    progress: Progress = silent,
    training: bool = True,
) -> Subject:
    """The scene at a path, with the options on views that its commands repeat; ``photos`` is a folder of photos, whose
    errors are those of :func:`~pointsplat_ns.compression.posed_photos.read_with_photos`. With ``training``, these are
    also trained on."""
    size, upward, sampled = parse_resolution(resolution), up_named(up), without_poses(poses)
    if photos is None:
        dense, given, file = read_found(path, poses)
        subject = subject_of(dense, None if sampled else path, given, resolution=size, up=upward, data=data)
    else:
        dense, posed = read_with_photos(path, photos, poses, data, size, progress, training)
        file = posed.poses
        subject = subject_of(dense, None, posed.views, resolution=size, up=upward)
        subject = replace(subject, held_out=lambda: posed.held_out, training=posed.training, photos=photos)
    named = {
        "--poses": NO_POSES if sampled else file,
        "--resolution": None if size is None else size_text(size),
        "--data": data,
    }
    words = [word for option, value in named.items() if value is not None for word in (option, str(value))]
    words += [] if up is None else [f"--up={up}"]
    return replace(subject, path=path, name=name_of(path), words=tuple(words))


def check_options(
    keep: tuple[Keep | str, ...],
    by: tuple[str, ...],
    sh: tuple[str, ...],
    repairs: tuple[str, ...],
    within: float,
    views: int,
) -> tuple[Repair, ...]:
    """The repairs, each once, in the order of :data:`REPAIRS`. Raises PointSplatError if an option is invalid."""
    if not 0 < within < math.inf:
        raise PointSplatError(f"a loss of {within:g} dB; expected a positive number, such as 0.5")
    if views < 1:
        raise PointSplatError(f"{views} views; expected at least one")
    if not keep or not by:
        raise PointSplatError("no budget or no method is named; expected at least one of each, such as 10%, merge")
    for budget in keep:
        if isinstance(budget, str):
            parse_keep(budget)
    for method in by:
        method_named(method)
    for name, given, known in (("sh", sh, ("all", "0", "1", "2", "3")), ("repairs", repairs, REPAIRS)):
        if not given or not {*given} <= {*known}:
            raise PointSplatError(f"{name}: {', '.join(given) or 'empty'}; expected some of {', '.join(known)}")
    return tuple(repair for repair in REPAIRS if repair in repairs)


def settings_of(
    dense: Gaussians, keep: Sequence[Keep | str], by: Sequence[str], sh: Sequence[str], repairs: Sequence[Repair]
) -> list[Setting]:
    """All combinations of options for a scene, each once. Raises BudgetError if a budget does not fit it."""
    degrees = [dense.sh_degree if some == "all" else min(int(some), dense.sh_degree) for some in sh]
    ways = itertools.product(by, degrees, keep, repairs)
    counted = (
        Setting(resolve_keep(len(dense), budget, degree, dense.traits), degree, repair, method)
        for method, degree, budget, repair in ways
    )
    return list(dict.fromkeys(counted))


@dataclass(frozen=True, eq=False)
class MadeScene:
    """A smaller scene, and the cost of making it."""

    scene: Gaussians
    seconds: float
    peak_bytes: int | None
    """Peak memory of this process while making it."""
    notes: tuple[str, ...] = ()
    """Lines of text, as of :class:`~pointsplat_ns.compression.prune.Pruned`."""
    compacted: Compacted | None = None
    """The whole result for a repaired scene; None for others."""


def make(
    dense: Gaussians,
    setting: Setting,
    new_views: Callable[[], ViewSource],
    progress: Progress,
    refiner: TrainedRefiner | None = None,
    training: Photos | None = None,
) -> MadeScene:
    """Make the scene of a setting. ``new_views`` makes a source of views; it is called once, so that time and result
    equal the command's. ``refiner`` and ``training`` are as for :class:`Subject`. Raises KeyboardInterrupt on Ctrl-C,
    also during a repair."""
    peak, start = PeakMemory(), time.perf_counter()
    sh = str(setting.sh_degree) if setting.sh_degree < dense.sh_degree else "all"
    compacted = None
    if setting.repair == "none":
        pruned = prune_scene(dense, PruneRequest(setting.count, setting.by, sh), new_views(), progress)
        scene, notes = pruned.scene, pruned.notes
    else:
        if setting.repair == "refiner":
            refiner = refiner or load_refiner()
        budget, on_photos = RepairBudget(EFFORTS[setting.repair]), setting.repair == "photos"
        request = CompactRequest.of(refiner, setting.count, setting.by, sh, repair=budget, photos=on_photos)
        compacted = compact_scene(dense, request, new_views(), progress, training)
        if compacted.interrupted:
            raise KeyboardInterrupt
        scene, notes = compacted.scene, compacted.notes
    return MadeScene(scene.to(dense.device), time.perf_counter() - start, peak.bytes(), notes, compacted)
