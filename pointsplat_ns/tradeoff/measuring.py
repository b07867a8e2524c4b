"""Makes the scene of a setting like its command, judges it and times it."""

from __future__ import annotations

import math
import shlex
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.compression.budget_search import FileLimit
from pointsplat_ns.compression.compact import compact_scene, rounding_stage
from pointsplat_ns.compression.compacted import Compacted
from pointsplat_ns.compression.photo_repair import Photos
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.requests import CompactRequest, PruneRequest, RepairBudget
from pointsplat_ns.compression.trained_refiner import SHIPPED, TrainedRefiner, load_refiner
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import usable_part
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import ROUNDING, rounding_for
from pointsplat_ns.looking.sizes import middle_sized
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import cut_sh, need_usable, ply_bytes
from pointsplat_ns.system.memory import PeakMemory
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.tradeoff.judging import Judge, Judged, JudgedViews
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import DENSE, EFFORTS, Setting, whole_of
from pointsplat_ns.views import Views

HeldOut = Callable[[int], tuple[Views, list[Tensor]]]
"""From a number to at most that many views of held-out photos, and the photos (H, W, 3)."""


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
    held_out: HeldOut | None = None
    """Its held-out photos; None if it cannot have any."""
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

    def names(self, setting: Setting) -> dict[str, str]:
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
        key = "_".join(keys)
        command = shlex.join([*words, "-o", f"{self.name}_{key}.ply"])
        return {"key": key, "label": ", ".join(labels), "command": command}


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


def through_file(scene: Gaussians, suffix: str) -> tuple[int, Gaussians]:
    """The size of a scene's file of a suffix such as ``.spz`` in bytes, and the scene after writing and reading: exact
    for a PLY, with fewer bits for other formats. Formats without a reader, such as ``.glb``, return ``scene``."""
    kind = format_to_write(suffix)
    if kind.suffix == ".ply":
        return ply_bytes(len(scene), scene.sh_degree), scene
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{suffix}"
        assert kind.write is not None
        # Without the warning of losses, which is for the scene that is kept.
        kind.write(usable_part(scene.detach().to("cpu", torch.float32)), path, silent)
        return path.stat().st_size, scene if kind.read is None else kind.read(path).to(scene.device)


def views_to_judge(subject: Subject, count: int) -> tuple[JudgedViews, str]:
    """At most ``count`` views to judge scenes in, of the size of comparisons in ``compact``, and a note. They are the
    views of held-out photos, or else the views of comparisons in ``compact``, which no repair uses. Raises DataError if
    there are none."""
    note = ""
    if subject.held_out is not None:
        try:
            views, photos = subject.held_out(count)
            whole = views if subject.resolution is None else views.resized(max(subject.resolution))
            middle = middle_sized(whole)
            photographed = JudgedViews(views, photos, "held-out photos of the dataset")
            return photographed.resized(max(middle.width, middle.height)), ""
        except (SceneError, DataError) as error:
            note = f"there are no held-out photos: {error}"
    return JudgedViews.compared(subject.new_views(), count), note


class Measurer:
    """Makes scenes of settings and measures them in at most ``views`` views. Without ``timed``, times are NaN. Raises
    SceneError if no Gaussian can be drawn, and DataError if there are no views."""

    def __init__(self, subject: Subject, views: int, progress: Progress, timed: bool = True):
        need_usable(subject.dense)
        self.subject, self.dense, self.timed = subject, subject.dense, timed
        self.dense_ms: float | None = None
        """Time of a frame of the dense scene from an earlier measurement; set before the first judgement."""
        self.notes: dict[str, None] = {}
        self._kept: dict[Setting, MadeScene] = {}
        progress("looking for views", 0.0)
        self.judged_views, note = views_to_judge(subject, views)
        self.note(note)

    def note(self, text: str) -> None:
        """Keep a line of text for the reader, once, unless it is empty."""
        if text:
            self.notes[text] = None

    @cached_property
    def judge(self) -> Judge:
        """The judge of all scenes."""
        judge = Judge(self.dense, self.judged_views, self.dense_ms)
        self.note(judge.no_lpips)
        return judge

    def cut_psnr(self, degree: int) -> float:
        """PSNR in dB of the dense scene's renders without the SH bands above a degree, against all bands."""
        return self.judge.psnr(cut_sh(self.dense, degree))

    def measure_dense(self, show: Progress) -> Point:
        """The dense scene's point; ``show`` as for :meth:`measure`."""
        point = self._point(whole_of(self.dense, DENSE), MadeScene(self.dense, 0.0, None), show)
        return replace(point, against_dense=replace(point.against_dense, psnr=math.inf))

    def measure(self, setting: Setting, show: Progress) -> Point:
        """The point of a setting. ``show`` is called with the name of the current task (empty during the judgement) and
        its share done."""
        return self._point(setting, self.made(setting, show), show)

    def made(self, setting: Setting, show: Progress = silent) -> MadeScene:
        """The scene of a setting. The latest scenes are kept, with no more Gaussians in all than the dense scene."""
        if setting not in self._kept:
            subject = self.subject
            made = make(self.dense, setting, subject.new_views, show, subject.refiner, subject.training)
            self._kept[setting] = self._rounded(made)
            while len(self._kept) > 1 and sum(len(kept.scene) for kept in self._kept.values()) > len(self.dense):
                self._kept.pop(next(iter(self._kept)))
        return self._kept[setting]

    def _rounded(self, made: MadeScene) -> MadeScene:
        """The scene of a compressed file: its numbers are rounded as far as its error allows, as by ``--keep auto``."""
        kind = format_to_write(self.subject.suffix)
        if kind.rounded is None or (psnr := self.judge.psnr(made.scene)) > ROUNDING.best_psnr:
            return made
        limit, compacted = FileLimit(kind, math.inf, rounding_for(psnr, made.scene.sh_degree)), made.compacted
        if compacted is None:
            return replace(made, scene=limit.rounded(made.scene))
        compacted = replace(
            compacted, stages=(*compacted.stages, *rounding_stage(compacted.last, limit, compacted.reference))
        )
        return replace(made, scene=compacted.scene.to(made.scene.device), compacted=compacted)

    def _point(self, setting: Setting, made: MadeScene, show: Progress) -> Point:
        size, scene = through_file(made.scene, self.subject.suffix)
        judged = self.judge.judge(scene, lambda done: show("", done), self.timed)
        figures = {"by": setting.by, "share": setting.count / len(self.dense), "repair": setting.repair, "bytes": size}
        return point_of(made, judged, **self.subject.names(setting), **figures)


def point_of(made: MadeScene, judged: Judged, **named: Any) -> Point:
    """The point of a made and judged scene; ``named`` are the other fields of :class:`Point`."""
    return Point(
        gaussians=len(made.scene), sh_degree=made.scene.sh_degree, seconds=made.seconds, peak_bytes=made.peak_bytes,
        **vars(judged), **named,
    )  # fmt: skip
