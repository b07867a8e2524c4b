"""The record of what lab/judge/judge.py measured: rows as JSON, tables as a page, and the table of
the README.

    python -m lab.judge.record judge.json judge_photos.json                            # takes new
    rows python -m lab.judge.record docs/record/judge.json docs/record/judge_photos.json    # writes
    the tables again

Rows of camera paths go to ``judge.json``, rows of held-out photos to ``judge_photos.json``. Both
are files that ``judge.py --resume`` takes up. A scene counts at a budget once prune, compact and a
mode of splat-transform are there.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd
import tyro

from lab.common.printing import markdown, percent, put_between
from lab.common.results import Row, grouped
from lab.common.scenes import group_of
from lab.common.ways import PEER
from lab.judge.scenes import LPIPS_WIDTH, MEASURES, PHOTOS
from pointsplat_ns.system.files import replacing

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "record"

OURS = ("prune", "compact")
"""Our ways, as rows call them."""

WAYS = (PEER, *OURS)
"""What tables show, in this order; splat-transform is the best of its modes."""

DIGITS = {"seconds": 1, "cpu_seconds": 1, "peak_bytes": -6} | {
    name: 3 if name.endswith("psnr") else 4 for name in MEASURES
}
"""Digits after the point that rows keep: a tenth of what tables show, or finer."""

README_TABLE = "judge"
"""Name of the marks around the table in the README."""

PAGE = """# What smaller scenes lose

`lab/judge/record.py` writes this page from [judge.json](judge.json) and [judge_photos.json](judge_photos.json), which
[`lab/judge/judge.py`](../benchmarks.md#the-judge) measured.

- Splats are judged in at most {views} views of a camera path, captures in the poses of at most {views} held-out photos
  and at their size. Every way gets the PLY alone: no photos and no poses.
- PSNR is in dB, over the pixels that the dense scene covers, by default against its renders.
- {peer} stands for the best of its modes in each cell: {modes}.
- Figures are means over scenes; leads have the smallest and its scene in brackets.
"""


def read(paths: Iterable[Path], program: str = "judge.py") -> tuple[list[Row], dict[str, Any]]:
    """All rows of some files of judge.py or another program, rounded, and their settings.

    Raises:
        SystemExit: if a file cannot be read or is no such file, or two have different settings or
            one row twice.
    """
    rows: list[Row] = []
    settings: dict[str, Any] = {}
    for path in paths:
        try:
            content = json.loads(path.read_text("utf-8"))
            new = content["rows"]
            its_own = content["settings"]
            keys = [_key(row) for row in new]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SystemExit(
                f"{path}: cannot be read ({error!r}); expected a file that {program} wrote"
            ) from error
        if settings and its_own != settings:
            other = [
                name for name in {**settings, **its_own} if settings.get(name) != its_own.get(name)
            ]
            found = ", ".join(
                f"{name} {its_own.get(name)}, the files before {settings.get(name)}"
                for name in other
            )
            raise SystemExit(f"{path}: was written with {found}; expected the same")
        if twice := {*keys} & {_key(row) for row in rows}:
            raise SystemExit(
                f"{path}: has rows that another file has, of {sorted({key[0] for key in twice})}"
            )
        settings = its_own
        rows = rows + [rounded(row) for row in new]
    return rows, settings


def _key(row: Row) -> tuple[Any, ...]:
    return row["scene"], row["at"], row["keep"], row["method"]


def rounded(row: Row) -> Row:
    """A row with only the digits that mean something."""
    result = dict(row)
    for name, digits in DIGITS.items():
        if result.get(name) is not None:
            result[name] = (
                round(result[name], digits) if digits > 0 else int(round(result[name], digits))
            )
    return result


def write_rows(rows: list[Row], settings: dict[str, Any], target: Path) -> None:
    """Write rows as a file that judge.py takes up, one row a line."""
    lines = ",\n".join(json.dumps(row) for row in rows)
    with replacing(target) as part:
        part.write_text(f'{{"settings": {json.dumps(settings)}, "rows": [\n{lines}\n]}}\n', "utf-8")


def compared(rows: list[Row]) -> pd.DataFrame:
    """Measures and costs by scene, width, budget and way, of the scenes, widths and budgets that
    have every one of :data:`WAYS`. splat-transform has the best of its modes by each measure, and
    the costs of that of the best PSNR."""
    table = pd.DataFrame([row for row in rows if not row["failed"]])
    table["way"] = table["method"].where(~table["method"].str.startswith(PEER), PEER)
    table = table[table["way"].isin(WAYS)].sort_values(
        "covered_psnr", ascending=False, kind="stable"
    )
    place = ["scene", "at", "keep"]
    groups = table[table.groupby(place)["way"].transform("nunique") == len(WAYS)].groupby(
        [*place, "way"]
    )
    found = groups.first()
    for name in MEASURES:
        found[name] = groups[name].min() if name.endswith("lpips") else groups[name].max()
    return found


class Figures:
    """Figures of all scenes, by width and budget.

    Args:
        rows: of any scenes, widths, budgets and ways.
    """

    def __init__(self, rows: list[Row]):
        self.table = compared(rows)
        self.ats = sorted(set(self.table.index.get_level_values("at")), key=at_order)
        self.keeps = sorted(set(self.table.index.get_level_values("keep")), reverse=True)

    def of(self, at: int | str, column: str) -> pd.DataFrame:
        """A figure at a width: rows by budget and scene, a column for each way."""
        return (
            self.table.xs(at, level="at")[column]
            .astype(float)
            .unstack("way")
            .dropna()
            .swaplevel()
            .sort_index()
        )

    def scenes(self, at: int | str) -> str:
        """How many scenes there are at a width: a number, or a span if budgets differ."""
        counts = set(self.of(at, "covered_psnr").groupby("keep").size())
        return f"{min(counts)} to {max(counts)}" if len(counts) > 1 else str(*counts)

    def lead(self, method: str, at: int | str, column: str) -> pd.Series:
        """Lead in dB of ``prune`` over splat-transform or of ``compact`` over ``prune``, by budget
        and scene."""
        values = self.of(at, column)
        return values[method] - values[PEER if method == "prune" else "prune"]


def means(values: pd.DataFrame, digits: int) -> dict[str, dict[float, str]]:
    """The mean of a figure over scenes, by way and budget."""
    found = values.groupby("keep").mean()
    return {
        _way(way): {keep: f"{value:.{digits}f}" for keep, value in found[way].items()}
        for way in WAYS
    }


def least(values: pd.Series) -> dict[float, str]:
    """By budget: the mean of a lead over scenes, and in brackets the smallest and its scene."""
    return {
        keep: f"{same.mean():+.2f} ({same.min():+.2f} {same.idxmin()})"
        for keep, same in values.groupby("keep")
        for same in [same.droplevel("keep")]
    }


def at_order(at: int | str) -> tuple[bool, int | str]:
    """Sorts widths, with photos last."""
    return isinstance(at, str), at


def page(rows: list[Row], settings: dict[str, Any]) -> str:
    """The page of all tables."""
    figures = Figures(rows)
    modes = sorted({row["method"] for row in rows if row["method"].startswith(PEER)})
    parts = [
        PAGE.format(
            views=settings["views"],
            peer=PEER,
            modes=", ".join(mode.removeprefix(PEER).strip() for mode in modes),
        ),
        "## Scenes\n\n" + SCENES + "\n\n" + _scene_lines(rows, figures),
        *(section(figures, at) for at in figures.ats if at == PHOTOS or at >= LPIPS_WIDTH),
    ]
    if table := _unlearned_table(rows, figures):
        parts.append(
            "## Scenes that the network was not trained on\n\n" + UNLEARNED + "\n\n" + table
        )
    parts.append("## Time\n\n" + TIME + "\n\n" + _cost_table(figures))
    if failed := [row for row in rows if row["failed"]]:
        lines = "\n".join(
            f"- {row['scene']}, {percent(row['keep'])}: {row['method']}" for row in failed
        )
        parts.append(f"## Failed\n\n{lines}")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def section(figures: Figures, at: int | str) -> str:
    """What the page says of one width, or of held-out photos."""
    title = "Held-out photos" if at == PHOTOS else f"{at} pixels wide"
    parts = [f"## {title}", f"{_count(figures.scenes(at))}."]
    if at in (PHOTOS, *[other for other in figures.ats if other != PHOTOS][-1:]):
        parts.append("PSNR, and leads in dB:\n\n" + _lead_table(figures, at, "covered_psnr"))
    if at == PHOTOS:
        parts.append("PSNR against the photos:\n\n" + _mean_table(figures, at, "photo_psnr", 2))
    if at == LPIPS_WIDTH and (table := _mean_table(figures, at, "dense_lpips", 3)):
        parts.append(f"LPIPS, lower is better:\n\n{table}")
    return "\n\n".join(parts)


LEARNED = ("mujoco_tabletop", "pc_playbot", "pc_statue_st_peter", "lounge")
"""Scenes of the list "judged" that the network of ``compact``'s repairs was trained on (FEEDBACK.md
beside it)."""

SCENES = f"""No constant is chosen on [judged scenes](../benchmarks.md#scenes). They showed the need of three
rules, whose constants come from scenes for tuning: repairs hold from nearer places (rock, taebak), merging before a
white background (ethiopianHead), and sampled views show little blur (apt_kitchen_balcony).
The network of `compact` was trained on {", ".join(LEARNED)}.
Rows of captures are older: of other sampled views, and of repairs of 48 steps."""

UNLEARNED = (
    "The gain of `compact` over `prune` in dB without the scenes of its training, in brackets "
    "with them."
)

TIME = """CPU seconds and peak memory of one process, mean (largest) over scenes. splat-transform stands for the mode of
the best PSNR."""


def _scene_lines(rows: list[Row], figures: Figures) -> str:
    """All scenes with their Gaussians, by what they are judged in and by list, and what was not
    measured."""
    lists: dict[str, list[str]] = {}
    missing = []
    shown = figures.table.index.droplevel("way")
    for (at, scene), same in sorted(
        grouped(rows, lambda row: (row["at"] == PHOTOS, row["scene"])).items()
    ):
        there = set(shown[shown.get_level_values("scene") == scene].get_level_values("keep"))
        if gaps := [percent(keep) for keep in figures.keeps if keep not in there]:
            missing.append(f"{scene} at {', '.join(gaps)}")
        where = (
            f"Held-out photos, {group_of(scene) or 'other'}"
            if at
            else f"Camera path, {group_of(scene) or 'other'}"
        )
        lists.setdefault(where, []).append(f"{scene} ({same[0]['gaussians']:,})")
    lines = "\n".join(f"- {where}: {', '.join(scenes)}." for where, scenes in lists.items())
    return (
        "Gaussians in brackets:\n\n"
        + lines
        + (f"\n\nNot measured: {'; '.join(missing)}." if missing else "")
    )


def _by_budget(figures: Figures, head: str, columns: dict[str, dict[float, str]]) -> str:
    """A table with a row for each budget that has all columns; empty if none has."""
    keeps = [keep for keep in figures.keeps if all(keep in column for column in columns.values())]
    lines = [[percent(keep), *(column[keep] for column in columns.values())] for keep in keeps]
    return markdown([head, *columns], lines) if lines else ""


def _mean_table(figures: Figures, at: int | str, column: str, digits: int) -> str:
    return _by_budget(figures, "kept", means(figures.of(at, column), digits))


def _lead_table(figures: Figures, at: int | str, column: str) -> str:
    ours, repaired = (least(figures.lead(method, at, column)) for method in OURS)
    leads = {f"`prune` over {PEER}": ours, "`compact` over `prune`": repaired}
    return _by_budget(figures, "kept", means(figures.of(at, column), 2) | leads)


def _unlearned_table(rows: list[Row], figures: Figures) -> str:
    others = Figures([row for row in rows if row["scene"] not in LEARNED])
    lines = []
    for at in others.ats:
        without, gains = (
            each.lead("compact", at, "covered_psnr").groupby("keep").mean()
            for each in (others, figures)
        )
        cells = [
            f"{without[keep]:+.2f} ({gains[keep]:+.2f})"
            for keep in figures.keeps
            if keep in without
        ]
        lines.append([str(at), *cells])
    return markdown(["width", *map(percent, others.keeps)], lines) if lines else ""


def _cost_table(figures: Figures) -> str:
    lines = []
    for kind, photos in (("splats", False), ("captures", True)):
        for at in [at for at in figures.ats if (at == PHOTOS) == photos][:1]:
            cells = []
            for name, scale, digits in (("cpu_seconds", 1, 0), ("peak_bytes", 1e-9, 2)):
                found = (scale * figures.of(at, name)).groupby("keep").agg(["mean", "max"])
                cells.append(
                    {
                        keep: " / ".join(
                            f"{found.loc[keep, (way, 'mean')]:.{digits}f} "
                            f"({found.loc[keep, (way, 'max')]:.{digits}f})"
                            for way in WAYS
                        )
                        for keep in found.index
                    }
                )
            lines += [
                [kind, percent(keep), *(cell[keep] for cell in cells)]
                for keep in (0.5, 0.1)
                if keep in cells[0]
            ]
    ways = " / ".join(map(_way, WAYS))
    return markdown(["scenes", "kept", f"CPU seconds: {ways}", "GB"], lines) if lines else ""


def readme_table(rows: list[Row]) -> str:
    """The table of the README: means of all ways in the largest pictures, and the smallest leads
    over all pictures."""
    figures = Figures(rows)
    at = [at for at in figures.ats if at != PHOTOS][-1:] or figures.ats
    means = figures.of(at[0], "covered_psnr").groupby("keep").mean()
    leads = [
        pd.concat([figures.lead(way, at, "covered_psnr") for at in figures.ats])
        .groupby("keep")
        .min()
        for way in OURS
    ]
    lines = [
        [
            percent(keep),
            *(f"{means.loc[keep, way]:.1f}" for way in WAYS),
            *(f"{lead[keep]:+.1f}" for lead in leads),
        ]
        for keep in figures.keeps
        if keep in means.index
    ]
    return markdown(
        ["kept", *map(_way, WAYS), "smallest lead of `prune`", "of `compact` over it"], lines
    )


def _count(scenes: str) -> str:
    return f"{scenes} scene{'' if scenes == '1' else 's'}"


def _way(way: str) -> str:
    return f"`{way}`" if way in OURS else way


def main(
    files: tyro.conf.Positional[tuple[Path, ...]],
    record: Path = FOLDER,
    readme: Path = ROOT / "README.md",
) -> None:
    """Write the record of what judge.py measured.

    Args:
        files: that judge.py wrote with --json.
        record: folder for judge.json, judge_photos.json and judge.md.
        readme: the page that has a table between two marks.
    """
    rows, settings = read(files)
    if compared(rows).empty:
        raise SystemExit(
            f"{', '.join(map(str, files))}: no scene has {', '.join(WAYS)} at one budget"
        )
    with_table = put_between(readme.read_text("utf-8"), readme_table(rows), readme, README_TABLE)
    record.mkdir(parents=True, exist_ok=True)
    for name, photos in (("judge.json", False), ("judge_photos.json", True)):
        if some := [row for row in rows if (row["at"] == PHOTOS) == photos]:
            write_rows(some, settings, record / name)
    for target, written in ((record / "judge.md", page(rows, settings)), (readme, with_table)):
        with replacing(target) as part:
            part.write_text(written, "utf-8")
        print(target)


if __name__ == "__main__":
    tyro.cli(main)
