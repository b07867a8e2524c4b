"""Makes the scene of a setting as its command does, and says what that took."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.compression.compact import Compacted, compact_scene
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.requests import CompactRequest, PruneRequest, RepairBudget
from pointsplat_ns.compression.trained_refiner import TrainedRefiner, load_refiner
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.scene import read_scene, save
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.system.memory import PeakMemory
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.settings import EFFORTS, Setting


@dataclass(frozen=True, eq=False)
class Made:
    """A smaller scene, and what making it took."""

    scene: Gaussians
    seconds: float
    peak_bytes: int | None
    """Peak memory of this process meanwhile."""
    notes: tuple[str, ...] = ()
    """Lines of text, as of :class:`~pointsplat_ns.compression.prune.Pruned`."""
    compacted: Compacted | None = None
    """All that is known of a scene that was repaired; None of others."""


def make(
    dense: Gaussians,
    setting: Setting,
    new_views: Callable[[], ViewSource],
    progress: Progress,
    refiner: TrainedRefiner | None = None,
) -> Made:
    """Make the scene of a setting.

    Args:
        dense: N Gaussians.
        setting: how.
        new_views: where views come from. It is called anew for each scene, so that time and result are those of the
            command, which finds nothing prepared.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].
        refiner: what repairs begin with; by default nothing, and the one that ships where it repairs alone.

    Raises:
        KeyboardInterrupt: also where a repair would be content with what it has reached.
    """
    peak, start = PeakMemory(), time.perf_counter()
    sh = str(setting.sh_degree) if setting.sh_degree < dense.sh_degree else "all"
    compacted = None
    if setting.repair == "none":
        pruned = prune_scene(dense, PruneRequest(setting.count, setting.by, sh), new_views(), progress)
        scene, notes = pruned.scene, pruned.notes
    else:
        if setting.repair == "refiner":
            refiner = refiner or load_refiner()
        budget = RepairBudget(EFFORTS[setting.repair])
        request = CompactRequest.of(refiner, setting.count, setting.by, sh, repair=budget)
        compacted = compact_scene(dense, request, new_views(), progress)
        if compacted.repaired is not None and compacted.repaired.interrupted:
            raise KeyboardInterrupt
        scene, notes = compacted.scene, compacted.notes
    return Made(scene.to(dense.device), time.perf_counter() - start, peak.bytes(), notes, compacted)


def through_file(scene: Gaussians, suffix: str) -> tuple[int, Gaussians]:
    """The size of a scene's file, bytes, and the scene as it is read from it: a PLY gives it back to the bit, others
    keep fewer bits.

    Args:
        scene: N Gaussians.
        suffix: of the format's files, such as ``.spz``. What is only written, as ``.glb``, is taken for what it was.
    """
    kind = format_to_write(suffix)
    if kind.suffix == ".ply":
        return ply_bytes(len(scene), scene.sh_degree), scene
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{suffix}"
        save(scene, path)
        return path.stat().st_size, scene if kind.read is None else read_scene(path).to(scene.device)
