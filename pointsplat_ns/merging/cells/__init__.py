"""Merging of scenes that are larger than memory: cell by cell, with files in between.

1. Parts of the curve with equally many Gaussians are the **cells**; each gets a file of its own (``partition.py``).
2. An evenly thinned scene gives views, visibility weights and axes of colours (``overview.py``).
3. A round finds pairs in each cell. The cheapest of all cells are merged: one price holds everywhere, and the count is
   exact (``merge.py``).
4. In each cell, members are regrouped, and their rows are written.

What a step has written is kept, and a command that was killed resumes from there (``scratch.py``).
"""

from pointsplat_ns.merging.cells.merge import merge_file
from pointsplat_ns.merging.cells.scratch import Scratch

__all__ = ["Scratch", "merge_file"]
