"""Finds the cheapest scene that meets targets, without a folder of measurements: what ``compact --target-db`` does."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace

from pointsplat_ns.compression.compact import Compacted, as_compacted
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.pruning import cut_sh
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.machine import busy_note
from pointsplat_ns.tradeoff.making import through_file
from pointsplat_ns.tradeoff.measuring import Measurer, Subject
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Repair, Setting
from pointsplat_ns.tradeoff.sweep import Options
from pointsplat_ns.tradeoff.targets import Search, Targets


def find_scene(
    subject: Subject, targets: Targets, by: str, repairs: tuple[Repair, ...], progress: Progress
) -> Compacted:
    """Find the cheapest scene that meets targets, as :class:`~pointsplat_ns.tradeoff.targets.Search` does.

    Scenes are judged in the views of :class:`~pointsplat_ns.tradeoff.sweep.Options`, so that the scene is the one that
    a sweep finds for the same targets; as they are read from files of the subject's format. Frames are timed only if
    there is a target for it. Where Ctrl-C ends the search, the cheapest of what it has found is given.

    Args:
        subject: the scene.
        targets: what to meet.
        by: the method of pruning.
        repairs: what may repair.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].

    Raises:
        BudgetError: if no scene meets all targets; the text says what is reachable.
        SceneError: if no Gaussian can be drawn.
        DataError: if there is no view.
        KeyboardInterrupt: if it is interrupted before a scene meets all targets.
    """
    start = time.perf_counter()
    options = Options(methods=(by,), repairs=repairs)
    measurer = Measurer(subject, options.views, progress, timed=targets.ms is not None)

    def measure(setting: Setting) -> Point:
        number = 1 + len(search.tried)
        return measurer.measure(setting, lambda what, share: progress(f"scene {number}: {what or 'looking'}", share))

    kind = format_to_write(subject.suffix)
    size = kind.bytes_of or _estimated(subject)
    search = Search(targets, options.plan(subject.dense), measure, measurer.cut_psnr, size, exact=kind.suffix == ".ply")
    interrupted = False
    try:
        if targets.ms is not None:
            measurer.measure_dense(lambda what, share: progress("timing the dense scene", share))
        found = search.run()
    except KeyboardInterrupt:
        so_far, interrupted = search.so_far(), True
        if so_far is None:
            raise
        found = so_far
    if targets.ms is not None:
        measurer.note(busy_note([p.others_cores for p in search.tried.values() if p.others_cores is not None]))
    made = measurer.made(found.setting, progress)
    compacted = made.compacted
    if compacted is None:
        compacted = as_compacted(subject.dense, made.scene, subject.new_views(), made.notes)
    notes = tuple(dict.fromkeys((*measurer.notes, *compacted.notes)))
    seconds = time.perf_counter() - start
    return replace(compacted, target=found.why, interrupted=interrupted, notes=notes, seconds=seconds)


def _estimated(subject: Subject) -> Callable[[int, int], int]:
    """The size of a file, bytes, by count and SH degree, if all Gaussians take as much as the dense scene's."""

    @functools.cache
    def whole(degree: int) -> int:
        return through_file(cut_sh(subject.dense, degree), subject.suffix)[0]

    return lambda count, degree: max(1, whole(degree) * count // len(subject.dense))
