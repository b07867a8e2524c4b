"""``pointsplat report``: what ``ns-eval`` wrote, as a table."""

from __future__ import annotations

from pathlib import Path

import tyro


def report(evaluation: tyro.conf.Positional[Path]) -> None:
    """Show what ns-eval wrote of a pointsplat run as a table.

    Args:
        evaluation: the JSON file.
    """
    import pointsplat_ns as ps

    ps.report(evaluation)
