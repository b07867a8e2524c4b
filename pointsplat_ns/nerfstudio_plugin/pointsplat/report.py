"""Prints the evaluation of a refiner as a table, and writes it as a page. nerfstudio is not imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pointsplat_ns.nerfstudio_plugin.pointsplat.report_page import COLUMNS, Block, number_text, write_report_page
from pointsplat_ns.nerfstudio_plugin.pointsplat.results import VARIANTS, read_evaluation
from pointsplat_ns.system.terminal import print_table

PHOTOS = "photos"
"""The reference of evaluations that name none."""


def report(evaluation: str | Path, html: str | Path | None = None) -> None:
    """Print the results that ``ns-eval`` wrote for a ``pointsplat`` run: dense, pruned and refined scenes side by side.

    PSNR is in dB, fps is one over the median time of a frame, and megabytes are 10^6 bytes of float32 parameters.

    Args:
        evaluation: the JSON file.
        html: file to write the same to with charts, as one page that loads nothing; None for none.

    Raises:
        DataError: if the file is missing or is not such an evaluation.
        SceneError: if the page cannot be written.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.report("evaluation.json")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.DataError: evaluation.json: cannot be read (No such file or directory); expected what \
ns-eval wrote
    """
    results = read_evaluation(Path(evaluation))
    show_report(results)
    if html is not None:
        parts = [(_reference(part), _blocks(results, part)) for part in _parts(results)]
        write_report_page(Path(evaluation).stem, _settings(results), parts, _note(results), Path(html))


def show_report(results: dict[str, Any]) -> None:
    """Print an evaluation: a table for the scenes compared with photos, one for those compared with dense renders, and
    the reason if LPIPS is missing."""
    for part in _parts(results):
        blocks = _blocks(results, part)
        rows = [
            (
                block.name if variant == VARIANTS[0] else "",
                block.seen if variant == VARIANTS[0] else "",
                variant,
                *(number_text(block.variants[variant][column], digits, "-") for column, _, digits in COLUMNS),
            )
            for block in blocks
            for variant in VARIANTS
        ]
        header = ("scene", "seen", "variant", *(name for _, name, _ in COLUMNS))
        title = f"{_settings(results)}; compared with {_reference(part)}"
        print_table(header, rows, title=title, left=(0, 1, 2), section=len(VARIANTS))
    if note := _note(results):
        print(note)


def _parts(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The parts of an evaluation, one per reference."""
    other = results.get("against_dense_renders")
    return [results] if other is None else [results, other]


def _reference(part: dict[str, Any]) -> str:
    """Text that says what a part was compared with."""
    reference = part.get("reference", PHOTOS)
    return {PHOTOS: "held-out photos", "dense renders": "the dense scenes' own renders"}.get(reference, reference)


def _settings(results: dict[str, Any]) -> str:
    """Text that says how the scenes were pruned and refined."""
    settings = results.get("settings", {})
    return f"keep {settings.get('keep')}, by {settings.get('by')}, refiner {settings.get('size')}"


def _note(results: dict[str, Any]) -> str:
    """The reason if LPIPS is missing; else an empty text."""
    return f"no LPIPS: {results['lpips_note']}" if "lpips_note" in results else ""


def _blocks(results: dict[str, Any], part: dict[str, Any]) -> list[Block]:
    """The scenes of a part, then the averages if there are several scenes."""
    reference = part.get("reference", PHOTOS)
    blocks = [
        Block(name, "yes" if scene["seen_in_training"] else "never", scene)
        for name, scene in results["scenes"].items()
        if scene.get("reference", PHOTOS) == reference
    ]
    if len(blocks) > 1:
        averages = (("", "average"), ("yes", "average_seen"), ("never", "average_unseen"))
        blocks += [Block("average", seen, part[key], is_average=True) for seen, key in averages if key in part]
    return blocks
