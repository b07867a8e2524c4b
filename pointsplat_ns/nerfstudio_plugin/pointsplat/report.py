"""Reads the evaluation of a refiner, prints it as a table, and writes it as a page. nerfstudio is not imported."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import read_text
from pointsplat_ns.pages.html import page
from pointsplat_ns.system.terminal import print_table

VARIANTS = ("dense", "pruned", "refined")
"""The variants of each scene that an evaluation compares."""


COLUMNS = (("psnr", "PSNR dB", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS", 3), ("gaussians", "splats", 0),
           ("megabytes", "MB", 2), ("fps", "fps", 1))  # fmt: skip
"""Columns of the table: a value of each variant, the title, digits to show."""


"""The reference of evaluations that name none."""


class ReportBlock(NamedTuple):
    """A scene, or an average over scenes."""

    name: str
    seen: str
    """Whether the refiner was trained on them: "yes", "never", or empty where both are averaged."""
    variants: dict[str, dict[str, Any]]
    """By variant: values such as ``psnr``."""
    is_average: bool = False

    @property
    def title(self) -> str:
        """Name for people."""
        if self.is_average:
            return {"yes": "average, trained on", "never": "average, never seen"}.get(self.seen, "average")
        return f"{self.name} (never seen)" if self.seen == "never" else self.name


def read_evaluation(path: Path) -> dict[str, Any]:
    """The results in a file that ``ns-eval`` wrote for a pointsplat run; a DataError if it is none."""
    try:
        results = json.loads(read_text(path))["results"]
        _check(results)
        json.dumps(results, ensure_ascii=False).encode("utf-8")  # halves of characters could not be shown
        return results
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected what ns-eval wrote") from error
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(f"{path}: not an evaluation of a pointsplat run; expected what ns-eval wrote") from error


def _check(results: dict[str, Any]) -> None:
    """Check all that :mod:`~pointsplat_ns.nerfstudio_plugin.pointsplat.report` shows. Errors are those of Python where
    something is missing or of another type."""
    blocks = list(results["scenes"].values())
    if not blocks:
        raise ValueError("no scene")
    for scene in blocks:
        scene["seen_in_training"]
    results.get("settings", {}).get("keep")
    other = results.get("against_dense_renders")
    parts = [results] if other is None else [results, other]
    for part in parts:
        blocks += [part[name] for name in ("average", "average_seen", "average_unseen") if name in part]
    for block in blocks:
        for value in (
            block[variant][name]
            for variant in VARIANTS
            for name in ("psnr", "ssim", "lpips", "gaussians", "megabytes", "fps")
        ):
            if value is not None:
                float(value + 0)  # a text has no sum with a number, and 10^400 is no float
    for part in [*parts, *results["scenes"].values()]:
        if not isinstance(part.get("reference", ""), str):
            raise TypeError("reference")


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
    reference = part.get("reference", "photos")
    return {"photos": "held-out photos", "dense renders": "the dense scenes' own renders"}.get(reference, reference)


def _settings(results: dict[str, Any]) -> str:
    """Text that says how the scenes were pruned and refined."""
    settings = results.get("settings", {})
    return f"keep {settings.get('keep')}, by {settings.get('by')}, refiner {settings.get('size')}"


def _note(results: dict[str, Any]) -> str:
    """The reason if LPIPS is missing; else an empty text."""
    return f"no LPIPS: {results['lpips_note']}" if "lpips_note" in results else ""


def _blocks(results: dict[str, Any], part: dict[str, Any]) -> list[ReportBlock]:
    """The scenes of a part, then the averages if there are several scenes."""
    reference = part.get("reference", "photos")
    blocks = [
        ReportBlock(name, "yes" if scene["seen_in_training"] else "never", scene)
        for name, scene in results["scenes"].items()
        if scene.get("reference", "photos") == reference
    ]
    if len(blocks) > 1:
        averages = (("", "average"), ("yes", "average_seen"), ("never", "average_unseen"))
        blocks += [ReportBlock("average", seen, part[key], is_average=True) for seen, key in averages if key in part]
    return blocks


def write_report_page(
    title: str, settings: str, parts: list[tuple[str, list[ReportBlock]]], note: str, output: Path
) -> None:
    """Write one self-contained HTML file with charts and a table of every scene and variant.

    Args:
        title: name of the evaluation.
        settings: text that says how the scenes were pruned and refined.
        parts: what the scenes were compared with, and the scenes.
        note: a line for the reader; empty for none.
        output: the file to write.
    """
    from pointsplat_ns.io.files import replacing

    charts = (("psnr", "PSNR, dB", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS, less is better", 3))
    shown = [
        {
            "reference": reference,
            "charts": [chart for name, text, digits in charts if (chart := _chart(name, text, digits, blocks))],
            "rows": [_rows(block) for block in blocks],
        }
        for reference, blocks in parts
    ]
    columns = [text for _, text, _ in COLUMNS]
    text = page(
        "report.html", title=title, settings=settings, parts=shown, columns=columns, variants=VARIANTS, note=note
    )
    with replacing(output) as part:
        part.write_text(text, encoding="utf-8")


def _chart(name: str, title: str, digits: int, blocks: list[ReportBlock]) -> dict[str, Any] | None:
    """One row of marks for each block, with places in percent of the width; None where nothing was measured."""
    values = [_value(block.variants[variant][name]) for block in blocks for variant in VARIANTS]
    known = [value for value in values if value is not None]
    if not known:
        return None
    low, high = min(known), max(known)
    pad = max(0.06 * (high - low), 0.01)
    low, high = low - pad, high + pad

    def place(value: float) -> float:
        return round(100 * (value - low) / (high - low), 3)

    rows = []
    for block in blocks:
        marks = [
            {"variant": variant, "at": place(value), "text": number_text(value, digits)}
            for variant in VARIANTS
            if (value := _value(block.variants[variant][name])) is not None
        ]
        rows.append({"name": block.title, "is_average": block.is_average, "marks": marks})
    ticks = [{"at": place(tick), "text": f"{tick:g}"} for tick in _ticks(low, high)]
    return {"title": title, "rows": rows, "ticks": ticks}


def _ticks(low: float, high: float) -> list[float]:
    """Up to six round numbers from ``low`` to ``high``."""
    rough = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough)
    return [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _rows(block: ReportBlock) -> dict[str, Any]:
    """A block for the table: one row of texts for each variant."""
    values = block.variants
    cells = {v: [number_text(_value(values[v][name]), digits) for name, _, digits in COLUMNS] for v in VARIANTS}
    return {"name": block.title, "cells": cells}


def _value(value: Any) -> float | None:
    """A number to show; None for those that are missing, not finite, or mean nothing."""
    return float(value) if value is not None and abs(value) < 1e12 else None


def number_text(value: float | None, digits: int, unknown: str = "–") -> str:
    """A number with so many decimals; ``unknown`` for None."""
    return unknown if value is None else f"{value:,.{digits}f}"
