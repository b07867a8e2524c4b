"""Merges a PLY larger than memory cell by cell, and decides which files need it."""

from __future__ import annotations

import functools
import hashlib
import time
from dataclasses import dataclass
from pathlib import Path

import torch

import pointsplat_ns
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.pipeline.options import PruneOptions
from pointsplat_ns.pipeline.photos.posed_scene import PosesFile
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.pruning import found_by_trying
from pointsplat_ns.pruning.merging.by_cells import merge_file
from pointsplat_ns.pruning.merging.cells import Scratch
from pointsplat_ns.pruning.merging.settings import MERGING
from pointsplat_ns.rendering.comparison.sizes import RESOLUTION
from pointsplat_ns.scene.formats import format_to_read
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import PlyRows, read_ply
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.cluster import Cluster
from pointsplat_ns.system.files import bytes_text
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.workers import check_jobs
from pointsplat_ns.view_sampling.sampler import Sampler


@dataclass(frozen=True)
class MemorySettings:
    """Memory use of merging, and limits of the cell size."""

    cell: int = 400
    """Bytes of working memory per Gaussian, in addition to its parameters."""
    base: int = 900_000_000
    """Bytes of the interpreter, torch and a thinned scene."""
    most: int = 4_000_000
    """Maximum number of Gaussians in a cell. The limit keeps results independent of the memory that
    happens to be free."""
    least: int = 100_000
    """Minimum number of Gaussians in a cell."""


MEMORY = MemorySettings()


def rows_to_prune(
    scene: Path, options: PruneOptions, memory: float | None = None
) -> PlyRows | None:
    """Rows of a PLY to merge in cells; None to prune in memory, because the scene fits or options
    need all of it at once.

    Args:
        scene: path of a scene.
        options: options of pruning, and of views: a file of cameras, or sampled views.
        memory: limit in bytes; by default the free memory.

    Raises:
        SceneError: if the file is damaged, or ``memory`` is given and the file is not a binary 3DGS
            PLY.
        PointSplatError: if ``memory`` is given and too small for the scene with these options.
    """
    import psutil

    kind = format_to_read(scene) if scene.is_file() else None
    rows = PlyRows.open(scene, warn=False) if kind is not None and kind.read is read_ply else None
    if rows is None:
        if memory is not None:
            raise SceneError(
                f"{scene}: cannot be read in parts; expected a binary 3DGS PLY for a limit of "
                "memory, which `pointsplat convert` writes"
            )
        return None
    size = rows.count * (_row_bytes(rows) + MEMORY.cell)
    limit = psutil.virtual_memory().available if memory is None else memory - MEMORY.base
    if size <= limit:
        return None
    whole_scene_options = {
        f"--by {options.by}": options.method.score is not None,
        "--sh auto": options.sh == "auto",
        "--clean": options.clean,
        f"--keep {options.keep}": found_by_trying(options.budget),
    }
    needing = [name for name, given in whole_scene_options.items() if given]
    if needing and memory is not None:
        raise PointSplatError(
            f"{scene}: {rows.count:,} Gaussians take {bytes_text(size)} of memory with "
            f"{', '.join(needing)}; expected more memory, or merging in parts without these options"
        )
    if needing:
        return None
    return PlyRows.open(scene)


def prune_file(
    rows: PlyRows,
    output: Path,
    options: PruneOptions,
    memory: float | None = None,
    progress: Progress = silent,
    jobs: int = 1,
    cluster: Cluster | None = None,
) -> tuple[int, float]:
    """Merge a PLY cell by cell. A killed call resumes from a hidden folder beside the output.

    Args:
        rows: the scene, from :func:`rows_to_prune`.
        output: PLY to write.
        options: options of pruning, and of views: a file of cameras, or sampled views.
        memory: limit in bytes. Memory beyond the largest cell changes nothing.
        jobs: number of processes that share the cells, each within ``memory``.
        cluster: its workers share the cells instead, if given; they see the folder of ``output``.

    Returns:
        The number of drawable Gaussians before, and the duration in seconds.

    Raises:
        PointSplatError: if the memory is too small.
        SceneError: if a file cannot be read or written, or the disk has no room for temporary
            files.
        BudgetError: if the budget does not fit the scene.
        DataError: if the cameras are not usable, the number of jobs is invalid, or a worker does
            not see the folder.
    """
    start = time.perf_counter()
    check_jobs(jobs)
    if output.suffix.lower() != ".ply":
        raise SceneError(
            f"{output}: cannot be written in parts; expected a .ply for a scene larger than "
            "memory, which `pointsplat convert` converts"
        )
    if options.sh.isdigit():
        rows = rows.with_sh_degree(int(options.sh))
    most = MEMORY.most
    if memory is not None:
        bytes_per_gaussian = _row_bytes(rows) + MEMORY.cell
        needed = MEMORY.base + MEMORY.least * bytes_per_gaussian
        if memory < needed:
            raise PointSplatError(
                f"memory of {bytes_text(memory)} is too small; expected at least "
                f"{bytes_text(needed)}"
            )
        most = min(most, int((memory - MEMORY.base) / bytes_per_gaussian))
    given = None if options.sampled else options.poses
    resolution = options.size
    up = options.upward
    file = None if given is None else PosesFile.of(rows.path, given).relative_to(rows.traits.offset)
    known = None if file is None else file.views
    if known is not None and resolution is not None:
        known = known.resized(max(resolution))
    status = rows.path.stat()
    work = {
        "scene": str(rows.path.resolve()),
        "bytes": status.st_size,
        "changed": status.st_mtime_ns,
        "rest": rows.rest,
        "keep": str(options.keep),
        "most": most,
        "views": _digest(known),
        "resolution": list(resolution or RESOLUTION),
        "up": None if up is None else up.direction.tolist(),
        "settings": repr(MERGING),
        "version": [2, pointsplat_ns.__version__, torch.__version__],
    }

    def views(sample: Gaussians) -> Views | None:
        if file is None or known is None:
            return None
        file.check(sample)
        return known.spread(VIEW_COUNTS.weighed)

    def count_of(n: int) -> int:
        count = options.count_of(n, rows.sh_degree, rows.traits)
        assert count is not None
        return count

    count = count_of(rows.count)  # raises errors before the long work
    # Between rounds, every Gaussian takes 150 bytes.
    size = rows.count * (_row_bytes(rows) + 150) + count * _row_bytes(rows)
    place = output if cluster is None else output.absolute()
    scratch = Scratch(place.with_name(f".{output.name}.cells"), work, size)
    sampler = functools.partial(Sampler, resolution=resolution or RESOLUTION, up=up)
    with scratch.left_if_useful():
        before, _ = merge_file(
            rows,
            count_of,
            output,
            most,
            scratch,
            views,
            sampler,
            progress,
            jobs=jobs,
            cluster=cluster,
        )
    scratch.remove()
    return before, time.perf_counter() - start


def _row_bytes(rows: PlyRows) -> int:
    return 4 * (14 + 3 * rows.rest)


def _digest(views: Views | None) -> str:
    if views is None:
        return ""
    numbers = views.viewmats.double().numpy().tobytes() + views.Ks.double().numpy().tobytes()
    size = (views.width, views.height) if views.images is None else views.images
    return hashlib.sha256(numbers + repr(size).encode()).hexdigest()
