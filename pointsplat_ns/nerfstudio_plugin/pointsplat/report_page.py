"""Shows the evaluation of a refiner as one HTML file. nerfstudio is not imported."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from pointsplat_ns.nerfstudio_plugin.pointsplat.results import VARIANTS
from pointsplat_ns.pages.html import page

COLUMNS = (("psnr", "PSNR dB", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS", 3), ("gaussians", "splats", 0),
           ("megabytes", "MB", 2), ("fps", "fps", 1))  # fmt: skip
"""Columns of the table: a value of each variant, the title, digits to show."""


class Block(NamedTuple):
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


def write_report_page(title: str, settings: str, parts: list[tuple[str, list[Block]]], note: str, output: Path) -> None:
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


def _chart(name: str, title: str, digits: int, blocks: list[Block]) -> dict[str, Any] | None:
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


def _rows(block: Block) -> dict[str, Any]:
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
