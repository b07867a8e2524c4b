"""Searches for the smallest file that reaches a PSNR after all stages of compaction: ``compact --target-db``."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import replace

from pointsplat_ns.compression.budget_search import FileLimit, smallest_within
from pointsplat_ns.compression.compact import compact_scene, rounding_stage
from pointsplat_ns.compression.compacted import Compacted
from pointsplat_ns.compression.quality import Judge, decibels, through_file
from pointsplat_ns.compression.requests import CompactRequest
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import ROUNDING, rounding_for
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.system.progress import Progress, silent


def compact_to_psnr(
    dense: Gaussians, request: CompactRequest, views: ViewSource, progress: Progress = silent
) -> Compacted:
    """:func:`~pointsplat_ns.compression.compact.compact_scene` with the fewest Gaussians that reach ``target_db`` of
    the request, in place of its budget.

    Each count is judged as every command judges (:mod:`~pointsplat_ns.compression.quality`), after writing and reading
    the scene in the format of the request. Ctrl-C ends the search with the smallest scene found so far, if any.

    Raises:
        BudgetError: if not even all Gaussians reach it.
        SceneError, PointSplatError: as :func:`~pointsplat_ns.compression.compact.compact_scene`.
        DataError: if there are no views.
    """
    assert request.target_db is not None
    start, suffix, numbers = time.perf_counter(), request.prune.suffix, itertools.count(1)
    judge, kind = Judge(dense, views), format_to_write(suffix)

    def measure(count: int) -> tuple[float, Compacted]:
        size = f"size {next(numbers)}"
        asked = replace(request, prune=replace(request.prune, keep=count))
        made = compact_scene(dense, asked, views, lambda what, share: progress(f"{size}: {what}", share))
        if made.interrupted:
            raise KeyboardInterrupt
        if kind.rounded is not None and (psnr := judge.psnr(made.scene)[0]) <= ROUNDING.best_psnr:
            limit = FileLimit(kind, math.inf, rounding_for(psnr, made.scene.sh_degree))
            made = replace(made, stages=(*made.stages, *rounding_stage(made.last, limit, made.reference)))
        written_bytes, written = through_file(made.scene, suffix)
        psnr, _ = judge.psnr(written)
        reached = f"{decibels(psnr)} against the dense scene in {judge.where}"
        return psnr, replace(made, target=f"{reached}, {bytes_text(written_bytes)}, {len(made.scene):,} Gaussians")

    best, found = smallest_within(len(dense), measure, request.target_db, stoppable=True)
    target = f"{best.target}; {len(found.tried)} sizes tried" + (", interrupted" if found.interrupted else "")
    seconds = time.perf_counter() - start
    return replace(best, target=target, judge=judge, interrupted=found.interrupted, seconds=seconds)
