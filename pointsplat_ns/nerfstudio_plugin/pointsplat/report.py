"""Prints the evaluation of a refiner as a table. nerfstudio is not imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pointsplat_ns.nerfstudio_plugin.pointsplat.results import VARIANTS, read_evaluation

PHOTOS = "photos"
"""The reference of evaluations that name none."""

NAMES = {PHOTOS: "held-out photos", "dense renders": "the dense scenes' own renders"}
"""Texts for the table, by reference."""


def report(evaluation: str | Path) -> None:
    """Print the results that ``ns-eval`` wrote for a ``pointsplat`` run: dense, pruned and refined scenes side by side.

    PSNR is in dB, fps is one over the median time of a frame, and megabytes are 10^6 bytes of float32 parameters.

    Args:
        evaluation: the JSON file.

    Raises:
        DataError: if the file is missing or is not such an evaluation.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.report("evaluation.json")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.DataError: evaluation.json: cannot be read (No such file or directory); expected what \
ns-eval wrote
    """
    show_report(read_evaluation(Path(evaluation)))


def show_report(results: dict[str, Any]) -> None:
    """Print an evaluation: one table per reference, and the reason if LPIPS is missing."""
    from rich.console import Console

    for table in report_tables(results):
        Console().print(table)
    if "lpips_note" in results:
        print(f"no LPIPS: {results['lpips_note']}")


def report_tables(results: dict[str, Any]) -> list:
    """A rich table for the scenes compared with photos, and one for those compared with dense renders. No average mixes
    the two."""
    other = results.get("against_dense_renders")
    parts = [results] if other is None else [results, other]
    return [_table(results, part) for part in parts]


def _table(results: dict[str, Any], part: dict[str, Any]):
    """One row for each scene and variant of a part, then the averages; "seen" says whether the scene was trained on."""
    from rich.markup import escape
    from rich.table import Table

    settings = results.get("settings", {})
    reference = part.get("reference", PHOTOS)
    title = f"keep {settings.get('keep')}, by {settings.get('by')}, refiner {settings.get('size')}"
    table = Table(title=escape(f"{title}; compared with {NAMES.get(reference, reference)}"))
    table.add_column("scene")
    table.add_column("seen")
    table.add_column("variant")
    for name in ("PSNR dB", "SSIM", "LPIPS", "splats", "MB", "fps"):
        table.add_column(name, justify="right")
    blocks = [
        (name, "yes" if scene["seen_in_training"] else "never", scene)
        for name, scene in results["scenes"].items()
        if scene.get("reference", PHOTOS) == reference
    ]
    if len(blocks) > 1:
        averages = (("", "average"), ("yes", "average_seen"), ("never", "average_unseen"))
        blocks += [("average", seen, part[key]) for seen, key in averages if key in part]
    for title, seen, block in blocks:
        for i, row in enumerate(VARIANTS):
            values = block[row]
            table.add_row(
                escape(title) if i == 0 else "",
                seen if i == 0 else "",
                row,
                _number(values["psnr"], 2),
                _number(values["ssim"], 3),
                _number(values["lpips"], 3),
                _number(values["gaussians"], 0),
                _number(values["megabytes"], 2),
                _number(values["fps"], 1),
                end_section=i == len(VARIANTS) - 1,
            )
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"
