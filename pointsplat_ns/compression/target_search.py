"""Searches for the smallest file that reaches a PSNR after all stages of compaction: ``compact --target-db``."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from pointsplat_ns.compression.budget_search import FIRST_SHARE, SLOPE, FileLimit, find_count
from pointsplat_ns.compression.compact import compact_scene, rounding_stage
from pointsplat_ns.compression.compacted import Compacted
from pointsplat_ns.compression.quality import Judge, decibels, through_file
from pointsplat_ns.compression.requests import CompactRequest
from pointsplat_ns.errors import BudgetError
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
    the scene in the format of the request. Ctrl-C ends the search with the smallest scene found so far.

    Raises:
        BudgetError: if not even all Gaussians reach it.
        SceneError, PointSplatError: as :func:`~pointsplat_ns.compression.compact.compact_scene`.
        DataError: if there are no views.
        KeyboardInterrupt: on an interruption before any scene reaches it.
    """
    assert request.target_db is not None
    start, target, suffix = time.perf_counter(), request.target_db, request.prune.suffix
    judge, kind = Judge(dense, views), format_to_write(suffix)
    tried: dict[int, float] = {}
    best: Compacted | None = None

    def measure(count: int) -> float:
        nonlocal best
        made = compact_scene(
            dense, replace(request, prune=replace(request.prune, keep=count)), views,
            lambda what, share: progress(f"size {1 + len(tried)}: {what}", share),
        )  # fmt: skip
        if made.interrupted:
            raise KeyboardInterrupt
        if kind.rounded is not None and (psnr := judge.psnr(made.scene)[0]) <= ROUNDING.best_psnr:
            limit = FileLimit(kind, math.inf, rounding_for(psnr, made.scene.sh_degree))
            made = replace(made, stages=(*made.stages, *rounding_stage(made.last, limit, made.reference)))
        size, written = through_file(made.scene, suffix)
        tried[count], _ = judge.psnr(written)
        if tried[count] >= target:
            reached = f"{decibels(tried[count])} against the dense scene in {judge.where}"
            best = replace(made, target=f"{reached}, {bytes_text(size)}, {len(made.scene):,} Gaussians")
        return tried[count]

    interrupted = False
    try:
        first = max(1, round(FIRST_SHARE * len(dense)))
        find_count(measure, target, at_least=True, first=first, most=len(dense), slope=SLOPE, tolerance=0.1)
    except KeyboardInterrupt:
        interrupted = True
        if best is None:
            raise
    if best is None:
        raise BudgetError(
            f"no scene reaches --target-db {target:g} in this format: all {len(dense):,} Gaussians have "
            f"{tried[len(dense)]:.2f} dB in {judge.where}"
        )
    found = f"{best.target}; {len(tried)} sizes tried" + (", interrupted" if interrupted else "")
    return replace(best, target=found, interrupted=interrupted, seconds=time.perf_counter() - start)
