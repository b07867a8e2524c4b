"""Tables of the judge: each scene; mean, median and worst over scenes; and who is ahead of whom."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from statistics import fmean, median
from typing import Any

from rich.table import Table

from lab.common.compare import METRICS
from lab.common.printing import megabytes, number, table
from lab.common.results import Row, grouped
from lab.common.scenes import JUDGED, TUNING, group_of
from lab.common.ways import PEER, WAYS
from lab.judge.camera_paths import path_of
from lab.judge.scenes import MEASURES, PHOTOS

COSTS = ("seconds", "cpu_seconds", "peak_bytes")
"""What making a scene smaller took."""

HEADS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "covered_psnr": ("covered PSNR", number(2)),
    **{f"dense_{name}": (name.upper(), number(2 if name == "psnr" else 3)) for name in METRICS},
    **{f"photo_{name}": (f"photo {name.upper()}", number(2 if name == "psnr" else 3)) for name in METRICS},
    "count": ("splats", number(0)),
    "seconds": ("s", number(1)),
    "cpu_seconds": ("CPU s", number(1)),
    "peak_bytes": ("MB", megabytes),
}
"""Columns by what a row calls them: their heads, and how a value is written."""

AHEAD = {"covered_psnr": "against the dense scene's renders", "photo_psnr": "against held-out photos"}
"""What leads are taken of, and its name."""

GROUPS = ("tuning", "judged", "other", "all")
"""Groups of scenes, as means are shown."""

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


def leads(rows: list[Row], method: str, rivals: tuple[str, ...] | None) -> list[Row]:
    """How far a method is ahead, in dB, of the best of others at each scene and budget.

    Args:
        rows: of one width, one for each scene, budget and method.
        method: whose lead it is.
        rivals: the others, of which the best is chosen anew for each PSNR; None: all modes of splat-transform.

    Returns:
        A row for each scene and budget that has both.
    """
    result = []
    for (scene, keep), same in grouped(rows, lambda row: (row["scene"], row["keep"])).items():
        ours = [row for row in same if row["method"] == method]
        peers = [row for row in same if (row["method"].startswith(PEER) if rivals is None else row["method"] in rivals)]
        lead: Row = {"scene": scene, "keep": keep}
        for column in AHEAD:
            known = [row for row in peers if row[column] is not None]
            if ours and ours[0][column] is not None and known:
                best = max(known, key=lambda row: row[column])
                lead |= {column: ours[0][column] - best[column], f"{column}_peer": best["method"]}
        if len(lead) > 2:
            result.append(lead)
    return result


def all_leads(rows: list[Row]) -> list[Row]:
    """The leads of ``prune`` over the best mode of splat-transform, and of ``compact`` over ``prune``, in dB, for each
    scene, budget and width. The best mode is chosen anew for each of these and each PSNR."""
    found = []
    for at, same in grouped(rows, lambda row: row["at"]).items():
        for method, rivals in BEHIND.items():
            found += [{"method": method, "at": at} | lead for lead in leads(same, method, rivals)]
    return found


def summaries(rows: list[Row]) -> dict[str, list[Row]]:
    """What the file tells beside the rows."""
    return {"means": means(rows), "leads": all_leads(rows)}


def scene_table(rows: list[Row]) -> Table:
    """The rows of one scene; a dash for what cannot be had, no column for what none has."""
    columns = [name for name in HEADS if any(row.get(name) is not None for row in rows)]
    lines = [
        [row["at"], f"{100 * row['keep']:g} %", row["method"], *(HEADS[name][1](row.get(name)) for name in columns)]
        for row in rows
    ]
    title = f"{rows[0]['scene']}: against the dense scene's renders; MB: peak memory; photos last"
    return table(title, ["at", "kept", "way", *(HEADS[column][0] for column in columns)], lines, left=["way"])


def mean_tables(rows: list[Row]) -> Iterator[Table]:
    """For each width, mean, median and worst over scenes."""
    by_width = grouped(means(rows), lambda mean: mean["at"])
    for at, same in sorted(by_width.items(), key=lambda item: at_order(item[0])):
        columns = [name for name in MEASURES if any(name in mean for mean in same)]
        lines = []
        for mean in sorted(same, key=lambda mean: (GROUPS.index(mean["group"]), -mean["keep"])):
            about = [mean["group"], f"{100 * mean['keep']:g} %", mean["method"], mean["scenes"]]
            costs = [HEADS[name][1](mean.get(name)) for name in ("seconds", "peak_bytes")]
            worst = mean.get("covered_psnr_worst_scene", "-")
            lines.append([*about, *(_three(mean, column) for column in columns), worst, *costs])
        heads = ["for", "kept", "way", "scenes", *(HEADS[column][0] for column in columns), "worst", "s", "MB"]
        title = f"{_at(at)}: mean / median / worst over scenes; seconds and MB of peak memory: means"
        yield table(title, heads, lines, left=["way", "worst"])


def lead_tables(rows: list[Row]) -> Iterator[Table]:
    """For each width, who is ahead of whom by how much, with mean and worst over scenes."""
    by_kind = grouped(all_leads(rows), lambda lead: (lead["method"], lead["at"]))
    for method, rivals in BEHIND.items():
        over = f"the best mode of {PEER}" if rivals is None else " or ".join(rivals)
        for at in sorted({at for found, at in by_kind if found == method}, key=at_order):
            for column, where in AHEAD.items():
                if known := [lead for lead in by_kind[method, at] if column in lead]:
                    keeps = sorted({lead["keep"] for lead in known}, reverse=True)
                    title = f"{_at(at)}: {method} minus {over}, PSNR in dB {where}"
                    yield table(
                        title, ["scene", *(f"{100 * keep:g} %" for keep in keeps)], _lead_lines(known, column, keeps)
                    )


def _lead_lines(known: list[Row], column: str, keeps: list[float]) -> Iterator[list[str]]:
    """The leads of each scene over the best of its rivals; for each group of scenes and for all, mean and worst."""
    groups = grouped(known, lambda lead: group_of(lead["scene"]) or "other")
    for group, members in (groups | ({"all": known} if len(groups) > 1 else {})).items():
        for scene, same in grouped(members, lambda lead: lead["scene"]).items() if group != "all" else ():
            beside = {lead["keep"]: f"{lead[column]:+.2f} {lead[f'{column}_peer'].removeprefix(PEER)}" for lead in same}
            yield [scene, *(beside.get(keep, "-") for keep in keeps)]
        budgets = grouped(members, lambda lead: lead["keep"])
        means = {keep: fmean(lead[column] for lead in same) for keep, same in budgets.items()}
        worst = {keep: min(same, key=lambda lead: lead[column]) for keep, same in budgets.items()}
        yield [f"{group} mean", *(f"{means[keep]:+.2f}" if keep in means else "-" for keep in keeps)]
        least = (worst.get(keep) for keep in keeps)
        yield [f"{group} worst", *("-" if lead is None else f"{lead[column]:+.2f} {lead['scene']}" for lead in least)]


def scene_list() -> Table:
    """Which scenes are for tuning and which judge, and which have a camera path."""
    shown = Table(title="scenes; those with photos are judged in the poses of held-out photos")
    for name in ("scene", "for", "camera path"):
        shown.add_column(name)
    others = sorted({path.stem for path in path_of("").parent.glob("*.json")} - {*TUNING, *JUDGED})
    for name in (*TUNING, *JUDGED, *others):
        shown.add_row(name, group_of(name) or "other", path_of(name).name if path_of(name).is_file() else "-")
    return shown


def _three(mean: Row, column: str) -> str:
    """A figure's mean, median and worst."""
    if column not in mean:
        return "-"
    write = HEADS[column][1]
    return " / ".join(write(mean[name]) for name in (column, f"{column}_median", f"{column}_worst"))


def _at(at: int | str) -> str:
    return "held-out photos" if at == PHOTOS else f"{at} pixels wide"
