"""``pointsplat report``: prints the results of ``ns-eval`` as a table, or shows them on a page."""

from __future__ import annotations

from pathlib import Path

import tyro

from pointsplat_ns.cli.scene_options import claim_outputs


def report(evaluation: tyro.conf.Positional[Path], html: Path | None = None, force: bool = False) -> None:
    """Print the results that ns-eval wrote for a pointsplat run as a table.

    Args:
        evaluation: the JSON file of ns-eval.
        html: a .html file for the same with charts, one page that opens offline; by default none.
        force: overwrite an existing file.
    """
    import pointsplat_ns as ps

    claim_outputs(None, force, html=html)
    ps.report(evaluation, html)
    if html is not None:
        print(f"{html}: the same with charts")
