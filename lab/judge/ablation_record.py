"""The record of what lab/judge/ablation.py measured: rows as JSON, and a page that sums them up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from lab.common.printing import markdown
from lab.common.results import Row, grouped
from lab.common.scenes import group_of
from lab.judge import variants
from lab.judge.record import ROOT, read, write_rows
from lab.judge.scenes import PHOTOS
from lab.judge.variants import BASELINE, TABLES
from pointsplat_ns.io.files import replacing

FOLDER = ROOT / "docs" / "record"

POSES = "photos, poses given"
"""In place of a width: the poses of held-out photos, where merging is given those of the training photos."""

LITTLE = 0.1
"""Change in dB below which a variant has no row."""

PAGE = """# What each setting of merging is worth

`lab/judge/ablation.py` writes this page from [ablation.json](ablation.json), which it measured. Each variant turns a
rule off, or moves a setting to a value beside its default.

- A change is PSNR of the variant minus PSNR of the defaults, dB: mean (smallest…largest) over scenes. Below 0, the
  default is better.
- Splats are judged in at most {views} views of a camera path that was written by hand, {width} pixels wide.
- Captures are judged in the poses of at most {views} held-out photos, at the size of the photos: once merged without
  poses, once with the poses of the training photos.
- PSNR is that of [the judge](judge.md).
- CPU is CPU seconds of merging, relative to the defaults.
- Variants come in the order of their mean changes. `other_views` shows how much is chance.
- Fields of `pruning/merging/settings.py` and `looking/settings.py` say what they do.
"""


def settings_of(views: int, width: int) -> dict[str, Any]:
    """What rows depend on beside what they name themselves."""
    return {"views": views, "width": width, **variants.default_values()}


def key(row: Row) -> tuple[Any, ...]:
    """What tells a row from others of its scene."""
    return row["at"], row["keep"], row["method"]


@dataclass(frozen=True)
class Summary:
    """What a variant changes."""

    name: str
    changes: dict[float, list[float]]
    """Changes in dB over scenes and poses, by the share that is kept."""
    cpu_ratio: float
    """CPU seconds of merging over those with the defaults, summed over the same scenes."""

    @property
    def mean(self) -> float:
        """Mean change over all budgets, scenes and poses, dB."""
        return fmean(change for same in self.changes.values() for change in same)

    def cell(self, keep: float) -> str:
        """Mean, smallest and largest change at a budget."""
        same = self.changes.get(keep)
        return f"{fmean(same):+.2f} ({min(same):+.2f}…{max(same):+.2f})" if same else "-"

    @property
    def count(self) -> str:
        """Number of changes at each budget: a number, or a span if budgets differ."""
        counts = {len(same) for same in self.changes.values()}
        return f"{min(counts)} to {max(counts)}" if len(counts) > 1 else str(*counts)


def current(rows: Iterable[Row]) -> list[Row]:
    """The rows of the defaults, and of variants that the tables still have, with the same changes."""
    known = {BASELINE, *variants.names()}
    return [row for row in rows if row["method"] in known and row["changes"] == variants.changes_of(row["method"])]


def summaries(rows: Iterable[Row]) -> list[Summary]:
    """What each variant changes, the largest loss first. Rows without a row of the defaults do not count."""
    methods = grouped(current(rows), lambda row: row["method"])
    default = {(row["scene"], row["at"], row["keep"]): row for row in methods.pop(BASELINE, [])}
    found = []
    for name, same in methods.items():
        pairs = [(row, default[place]) for row in same if (place := (row["scene"], row["at"], row["keep"])) in default]
        if pairs:
            by_keep = grouped(pairs, lambda pair: pair[0]["keep"])
            changes = {
                keep: [row["covered_psnr"] - base["covered_psnr"] for row, base in group]
                for keep, group in by_keep.items()
            }
            seconds = [sum(pair[which]["cpu_seconds"] for pair in pairs) for which in (0, 1)]
            found.append(Summary(name, changes, seconds[0] / seconds[1]))
    return sorted(found, key=lambda summary: summary.mean)


def page(rows: list[Row], settings: dict[str, Any]) -> str:
    """The page of all tables."""
    rows = current(rows)
    keeps = sorted({row["keep"] for row in rows})
    parts = [PAGE.format(views=settings["views"], width=settings["width"]), "## Scenes", _scene_table(rows, keeps)]
    found = summaries(rows)
    for name, table in TABLES.items():
        of_table = [summary for summary in found if summary.name in table.variants]
        if of_table:
            parts += [f"## {table.title}", _variant_table(of_table, keeps, name, settings)]
    if moved := [name for name, value in variants.default_values().items() if settings.get(name, value) != value]:
        parts.append(f"Defaults that have changed since: {', '.join(f'`{name}`' for name in moved)}.")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _scene_table(rows: list[Row], keeps: list[float]) -> str:
    base = [row for row in rows if row["method"] == BASELINE]
    lines = []
    for (scene, at), same in sorted(grouped(base, lambda row: (row["scene"], str(row["at"]))).items()):
        psnr = {row["keep"]: f"{row['covered_psnr']:.2f}" for row in same}
        views = {PHOTOS: "held-out photos", POSES: "held-out photos, poses given"}.get(at, "camera path")
        cells = [psnr.get(keep, "-") for keep in keeps]
        lines.append([scene, f"{same[0]['gaussians']:,}", views, group_of(scene) or "other", *cells])
    text = "PSNR of the defaults, dB:\n\n"
    return text + markdown(["scene", "Gaussians", "views", "list", *map(_share, keeps)], lines)


def _variant_table(found: list[Summary], keeps: list[float], table: str, settings: dict[str, Any]) -> str:
    still = [each for each in found if all(abs(change) < LITTLE for same in each.changes.values() for change in same)]
    lines = []
    for summary in found:
        if summary in still:
            continue
        changes = variants.changes_of(summary.name)
        moves = "; ".join(
            f"`{field}` {_value(settings[f'{table}.{field}'])} to {_value(changes[field])}" for field in changes
        )
        cells = [summary.cell(keep) for keep in keeps]
        lines.append([f"`{summary.name}`", moves, *cells, f"{summary.cpu_ratio:.2f}", summary.count])
    heads = ["variant", "change", *map(_share, keeps), "CPU", "scenes and poses"]
    if len(counts := {summary.count for summary in found}) > 1:
        text = markdown(heads, lines)
    else:
        text = f"Scenes and poses: {counts.pop()}.\n\n" + markdown(heads[:-1], [line[:-1] for line in lines])
    return text + (
        f"\n\nWithin {LITTLE:g} dB in each: {', '.join(f'`{summary.name}`' for summary in still)}." if still else ""
    )


def _share(keep: float) -> str:
    return f"{100 * keep:g} %"


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"({', '.join(map(_value, value))})"
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def write(files: Iterable[Path], folder: Path) -> list[Path]:
    """Write ablation.json and ablation.md from files of ablation.py, and say which files these are.

    Raises:
        SystemExit: if a file cannot be read, two files have different settings or one row twice, or there is nothing to
            compare.
    """
    rows, settings = read(files, "ablation.py")
    rows = current(rows)
    if not summaries(rows):
        raise SystemExit(f"{', '.join(map(str, files))}: no variant and the defaults of one scene; expected some")
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(rows, settings, folder / "ablation.json")
    with replacing(folder / "ablation.md") as part:
        part.write_text(page(rows, settings), "utf-8")
    return [folder / "ablation.json", folder / "ablation.md"]
