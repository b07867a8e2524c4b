"""The table of what formats hold is made of the constants that readers and writers use."""

import math

from documented import ROOT
from pointsplat_ns.io.formats import FORMATS

PAGE = ROOT / "docs" / "formats.md"
SUFFIXES = (".ply", ".compressed.ply", ".spz", ".sog", ".splat", ".rad")
COLUMNS = ("positions", "sizes", "colours", "opacities", "rotations", "sh")


def cell(column, span):
    """One format's range and step of an attribute, as the page says them; sizes in units, not logarithms."""
    if span is None:
        return "none"
    sizes = column == "sizes"
    one = (lambda value: f"{math.exp(value):.3g}") if sizes else (lambda value: f"{value:.3g}")
    ends = [one(value) for value in (span.low, span.high) if math.isfinite(value)]
    limits = " to ".join(ends) if len(ends) == 2 else f"from {ends[0]}" if ends else ""
    step = f"{100 * math.expm1(span.step):.2g} % apart" if sizes else f"step {span.step:.2g}"
    return "; ".join(part for part in (limits, step if span.step else "", span.how) if part) or "float32"


def table():
    kinds = [next(kind for kind in FORMATS if kind.suffix == suffix) for suffix in SUFFIXES]
    lines = ["|File|Positions|Sizes|`f_dc`|Opacities|Rotations|SH|", "|" + "---|" * 7]
    for kind in kinds:
        cells = [cell(column, getattr(kind.capacity, column)) for column in COLUMNS]
        lines.append("|".join([f"|`{kind.suffix}`", *cells]) + "|")
    return "\n".join(lines)


def test_the_page_says_the_range_and_the_step_of_every_format():
    assert table() in PAGE.read_text("utf-8"), f"docs/formats.md has another table than the constants make:\n{table()}"
