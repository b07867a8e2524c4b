"""Makes the scene of a setting as its command does, and says what that took."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from pointsplat_ns.compression.compact import compact_scene
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.repair import RepairBudget
from pointsplat_ns.compression.trained_refiner import load_refiner
from pointsplat_ns.compression.view_source import ViewSource
from pointsplat_ns.gaussians import Gaussians
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


def make(dense: Gaussians, setting: Setting, new_views: Callable[[], ViewSource], progress: Progress) -> Made:
    """Make the scene of a setting.

    Args:
        dense: N Gaussians.
        setting: how.
        new_views: where views come from. It is called anew for each scene, so that time and result are those of the
            command, which finds nothing prepared.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].

    Raises:
        KeyboardInterrupt: also where a repair would be content with what it has reached.
    """
    peak, start = PeakMemory(), time.perf_counter()
    sh = str(setting.sh_degree) if setting.sh_degree < dense.sh_degree else "all"
    if setting.repair == "none":
        scene = prune_scene(dense, setting.count, setting.by, sh, views=new_views(), progress=progress).scene
    else:
        budget = RepairBudget(EFFORTS[setting.repair])
        compacted = compact_scene(
            dense, load_refiner(), setting.count, setting.by, sh, new_views(), progress, budget=budget
        )
        if compacted.repaired is not None and compacted.repaired.interrupted:
            raise KeyboardInterrupt
        scene = compacted.scene
    scene = scene.to(dense.device)
    return Made(scene, time.perf_counter() - start, peak.bytes())
