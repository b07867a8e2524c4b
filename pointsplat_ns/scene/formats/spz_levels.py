"""Levels of detail in SPZ files of Spark: a tree of Gaussians, of which the leaves are the scene.

The numbers of children (u16) and the first children (u32) of all Gaussians follow the last
attribute. Opacities of the tree are stored halved, because those of inner nodes exceed 1. Source:
``SpzEncoder`` and ``SpzDecoder`` in rust/spark-lib/src/spz.rs of github.com/sparkjsdev/spark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.formats.coding import Array, Blocks

NODE_BYTES = 6
"""Size of the links of a node."""

OPACITY_FACTOR = 2
"""Factor of the opacities of a tree."""


def leaves(links: bytes | memoryview, count: int, path: Path) -> Array:
    """Mask (N,) of the leaves of a tree with ``count`` nodes. Raises SceneError if ``links`` are
    too short, or no links of a tree."""
    blocks = Blocks(links, path)
    children = blocks.take("<u2", count).astype(np.int64)
    first = blocks.take("<u4", count).astype(np.int64)
    inner = children > 0
    total = int(children.sum())
    # Every node but a root has one parent, and a tree of N nodes has fewer than N children.
    if total < max(count, 1) and (first + children)[inner].max(initial=0) <= count:
        starts = np.repeat(first[inner], children[inner])
        before = np.repeat(np.cumsum(children[inner]) - children[inner], children[inner])
        parents = np.bincount(starts + np.arange(total) - before, minlength=count)
        if parents.max(initial=0) <= 1:
            return ~inner
    raise SceneError(
        f"{path}: the levels of detail of Spark in it are no tree, so its leaves are unknown; "
        "expected a file that Spark wrote; export the scene itself"
    )
