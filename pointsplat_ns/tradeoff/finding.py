"""Finds the cheapest scene that meets targets, without a folder of measurements: ``compact --target-db``."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace

from pointsplat_ns.compression.compact import as_compacted
from pointsplat_ns.compression.compacted import Compacted
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.pruning import cut_sh
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.machine import busy_note
from pointsplat_ns.tradeoff.measuring import Measurer, Subject, through_file
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.search import TargetSearch
from pointsplat_ns.tradeoff.settings import Repair, Setting, whole_of
from pointsplat_ns.tradeoff.targets import Targets


def find_scene(
    subject: Subject, targets: Targets, by: str, repairs: tuple[Repair, ...], progress: Progress
) -> Compacted:
    """Find the cheapest scene that meets targets by :class:`~pointsplat_ns.tradeoff.targets.TargetSearch`, with a
    method of pruning and the repairs to try.

    Scenes are judged in the views of :func:`~pointsplat_ns.tradeoff.measuring.views_to_judge`, after writing and
    reading them in the subject's format. Frames are timed only for a target of time. Ctrl-C ends the search with the
    cheapest scene found so far.

    Raises:
        BudgetError: if no scene meets all targets; the text tells the reachable values.
        SceneError: if no Gaussian can be drawn.
        DataError: if there are no views.
        KeyboardInterrupt: on an interruption before any scene meets all targets.
    """
    start = time.perf_counter()
    dense, timed = subject.dense, targets.ms is not None
    measurer = Measurer(subject, VIEW_COUNTS.compared, progress, timed=timed)

    def measure(setting: Setting) -> Point:
        number = 1 + len(search.tried)
        return measurer.measure(setting, lambda what, share: progress(f"scene {number}: {what or 'looking'}", share))

    kind = format_to_write(subject.suffix)
    size, bytes_of = _estimated(subject), kind.bytes_of
    if bytes_of is not None:
        size = lambda count, degree: bytes_of(count, degree, dense.traits)  # noqa: E731
    where, exact = measurer.judged_views.where, kind.suffix == ".ply"
    search = TargetSearch(targets, whole_of(dense, by), repairs, measure, measurer.cut_psnr, where, size, exact)
    interrupted = False
    try:
        if timed:
            measurer.measure_dense(lambda what, share: progress("timing the dense scene", share))
        found = search.run()
    except KeyboardInterrupt:
        so_far, interrupted = search.so_far(), True
        if so_far is None:
            raise
        found = so_far
    if timed:
        measurer.note(busy_note([point.others_cores for point in search.tried.values()]))
    made = measurer.made(found.setting, progress)
    compacted = made.compacted or as_compacted(dense, made.scene, subject.new_views(), made.notes)
    notes = tuple(dict.fromkeys((*measurer.notes, *compacted.notes)))
    seconds, why = time.perf_counter() - start, found.why
    if measurer.judged_views.photos is not None and compacted.last.after is not None and len(compacted.stages) > 1:
        why += f"; a repair is accepted in {compacted.last.after.where} of the photos that were trained on"
    return replace(compacted, target=why, interrupted=interrupted, notes=notes, seconds=seconds)


def _estimated(subject: Subject) -> Callable[[int, int], int]:
    """Estimate of a file's size in bytes by count and SH degree, from the mean bytes of the dense scene's Gaussians."""

    @functools.cache
    def whole(degree: int) -> int:
        return through_file(cut_sh(subject.dense, degree), subject.suffix)[0]

    return lambda count, degree: max(1, whole(degree) * count // len(subject.dense))
