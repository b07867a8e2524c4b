"""``pointsplat report``: prints the results of ``ns-eval`` as a table."""

from __future__ import annotations

from pathlib import Path

import tyro


def report(evaluation: tyro.conf.Positional[Path]) -> None:
    """Print the results that ns-eval wrote for a pointsplat run as a table.

    Args:
        evaluation: the JSON file of ns-eval.
    """
    import pointsplat_ns as ps

    ps.report(evaluation)
