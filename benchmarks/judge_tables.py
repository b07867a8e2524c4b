"""Tables of benchmarks/judge.py: each scene; mean, median and worst over scenes; and who is ahead of whom."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import fmean, median
from typing import Any

from compaction_tables import JUDGED, SHOWN, TUNING, Row, group_of, grouped, leads, number, summary, table_of_leads
from judge_paths import path_of
from judge_scenes import MEASURES, PHOTOS
from processes import WAYS
from rich.table import Table

from pointsplat_ns.tables.splat_transform import NAME

COSTS = ("seconds", "cpu_seconds", "peak_bytes")
"""What making a scene smaller took."""

HEADS = {"covered_psnr": ("covered PSNR", number(2))} | {
    name: SHOWN[name] for name in (*MEASURES, "count", *COSTS) if name in SHOWN
}
"""Columns by what a row calls them: their heads, and how a value is written."""

AHEAD = {"covered_psnr": "against the dense scene's renders", "photo_psnr": "against held-out photos"}
"""What leads are taken of, and its name."""

BEHIND = {"prune": None, "compact": ("prune",)}
"""Whose leads are told, and over whom; None: over all modes of splat-transform."""


def at_order(at: int | str) -> tuple[bool, int | str]:
    """Sorts widths, with photos last."""
    return isinstance(at, str), at


def ordered(rows: list[Row]) -> list[Row]:
    """Rows of a scene by width, then by budget, our own ways first."""
    ours = list(WAYS)

    def key(row: Row) -> Any:
        method = row["method"]
        return at_order(row["at"]), -row["keep"], (ours.index(method) if method in ours else len(ours), method)

    return sorted(rows, key=key)


def means(rows: list[Row]) -> list[Row]:
    """For each group of scenes and for all, width, budget and way: the mean, the median and the worst of each figure
    over the scenes that have it, with the worst scene."""
    groups = grouped(rows, lambda row: group_of(row["scene"]) or "other")
    if len(groups) > 1:
        groups = groups | {"all": rows}
    result = []
    for group, members in groups.items():
        for (at, keep, method), same in grouped(members, lambda row: (row["at"], row["keep"], row["method"])).items():
            found: Row = {"group": group, "at": at, "keep": keep, "method": method}
            found["scenes"] = sum(not row["failed"] for row in same)
            for name in (*MEASURES, *COSTS):
                known = [row for row in same if row.get(name) is not None]
                if known:
                    least = name in COSTS or name.endswith("lpips")
                    worst = (max if least else min)(known, key=lambda row: row[name])
                    values = [row[name] for row in known]
                    found |= {name: fmean(values), f"{name}_median": median(values), f"{name}_worst": worst[name]}
                    found[f"{name}_worst_scene"] = worst["scene"]
            result.append(found)
    return result


def all_leads(rows: list[Row]) -> list[Row]:
    """The leads of ``prune`` over the best mode of splat-transform, and of ``compact`` over ``prune``, in dB, for each
    scene, budget and width. The best mode is chosen anew for each of these and each PSNR."""
    found = []
    for at, same in grouped(rows, lambda row: row["at"]).items():
        for method, rivals in BEHIND.items():
            found += [{"method": method, "at": at} | lead for lead in leads(same, method, tuple(AHEAD), rivals)]
    return found


def summaries(rows: list[Row]) -> dict[str, list[Row]]:
    """What the file tells beside the rows."""
    return {"means": means(rows), "leads": all_leads(rows)}


def scene_table(rows: list[Row]) -> Table:
    """The rows of one scene; a dash for what cannot be had, no column for what none has."""
    shown = Table(title=f"{rows[0]['scene']}: against the dense scene's renders; MB: peak memory; photos last")
    columns = [name for name in HEADS if any(row.get(name) is not None for row in rows)]
    for name in ("at", "kept", "way", *(HEADS[column][0] for column in columns)):
        shown.add_column(name, justify="left" if name == "way" else "right")
    for (at, keep), same in grouped(rows, lambda row: (row["at"], row["keep"])).items():
        for row in same:
            start = [str(at), f"{100 * keep:g} %"] if row is same[0] else ["", ""]
            cells = ["-" if row.get(name) is None else HEADS[name][1](row[name]) for name in columns]
            shown.add_row(*start, row["method"], *cells, end_section=row is same[-1])
    return shown


def mean_tables(rows: list[Row]) -> Iterator[Table]:
    """For each width, mean, median and worst over scenes."""
    by_width = grouped(means(rows), lambda mean: mean["at"])
    for at, same in sorted(by_width.items(), key=lambda item: at_order(item[0])):
        shown = Table(title=f"{_at(at)}: mean / median / worst over scenes; seconds and MB of peak memory: means")
        columns = [name for name in MEASURES if any(name in mean for mean in same)]
        for name in ("for", "kept", "way", "scenes", *(HEADS[column][0] for column in columns), "worst", "s", "MB"):
            shown.add_column(name, justify="left" if name in ("for", "way", "worst") else "right")
        by_budget = grouped(sorted(same, key=lambda mean: -mean["keep"]), lambda mean: (mean["group"], mean["keep"]))
        for (group, keep), members in sorted(by_budget.items(), key=lambda item: _group_order(item[0][0])):
            for mean in members:
                start = [group, f"{100 * keep:g} %"] if mean is members[0] else ["", ""]
                cells = [_three(mean, column) for column in columns]
                costs = [HEADS[name][1](mean[name]) if name in mean else "-" for name in ("seconds", "peak_bytes")]
                worst = mean.get("covered_psnr_worst_scene", "-")
                start += [mean["method"], str(mean["scenes"])]
                shown.add_row(*start, *cells, worst, *costs, end_section=mean is members[-1])
        yield shown


def lead_tables(rows: list[Row]) -> Iterator[Table]:
    """For each width, who is ahead of whom by how much, with mean and worst over scenes."""
    by_kind = grouped(all_leads(rows), lambda lead: (lead["method"], lead["at"]))
    for method, rivals in BEHIND.items():
        for at in sorted({at for found, at in by_kind if found == method}, key=at_order):
            for column, where in AHEAD.items():
                over = f"the best mode of {NAME}" if rivals is None else " or ".join(rivals)
                lines = list(summary(by_kind[method, at], column, together=True))
                shown = table_of_leads(lines, f"{_at(at)}: {method} minus {over}, PSNR in dB {where}")
                if shown is not None:
                    yield shown


def scene_list() -> Table:
    """Which scenes are for tuning and which judge, and which have a camera path."""
    shown = Table(title="scenes; those with photos are judged in the poses of held-out photos")
    for name in ("scene", "for", "camera path"):
        shown.add_column(name)
    others = sorted({path.stem for path in path_of("").parent.glob("*.json")} - {*TUNING, *JUDGED})
    for name in (*TUNING, *JUDGED, *others):
        shown.add_row(name, group_of(name) or "other", path_of(name).name if path_of(name).is_file() else "-")
    return shown


def _group_order(group: str) -> int:
    known = ("tuning", "judged", "other", "all")
    return known.index(group)


def _three(mean: Row, column: str) -> str:
    """A figure's mean, median and worst."""
    if column not in mean:
        return "-"
    write = HEADS[column][1]
    return " / ".join(write(mean[name]) for name in (column, f"{column}_median", f"{column}_worst"))


def _at(at: int | str) -> str:
    return "held-out photos" if at == PHOTOS else f"{at} pixels wide"
