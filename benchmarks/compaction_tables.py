"""Tables of benchmarks/compaction.py: rows, means with the worst scene, and how far merging is ahead of its peer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from statistics import fmean
from typing import Any

from held_out import BRIGHTNESS, COLUMNS, HALVES
from rich.table import Table

from pointsplat_ns.tables.splat_transform import NAME

Row = dict[str, Any]

TUNING = (
    *("apt_bathroom", "bouquet", "pc_flowers", "pc_statue_massa", "plant_pilea", "kettle_pod"),
    *("pc_statue_angel", "pc_statue_narcissus", "kitchen", "fox", "final_3dgs", "vr_project", "room", "room5"),
)
"""Scenes that ``merge`` may be tuned on."""
JUDGED = (
    *("apt_kitchen_balcony", "cake_fraisier", "mujoco_tabletop", "pc_playbot", "rock", "pc_statue_angel_kneeling"),
    *("pc_statue_angel_with_candlestick", "pc_statue_st_peter", "pc_statue_trumpet", "lounge", "diorama"),
    *("ethiopianHead", "dataset_perso", "lego_dense"),
)
"""Scenes that nothing is tuned on: they were named before the first measurement. See docs/benchmarks.md."""

MERGE = "merge"
"""The method that is compared with its peer."""

PAIRS = ("dense_psnr", "photo_psnr")
"""What it is compared by."""


def group_of(scene: str) -> str:
    """ "tuning", "judged", or "" for any other scene."""
    return "tuning" if scene in TUNING else "judged" if scene in JUDGED else ""


def grouped(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Rows by a key, in the order that the keys come in."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def averages(rows: list[Row]) -> list[Row]:
    """Means over scenes for each group, budget and method, with the scene that loses most against the dense renders."""
    result = []
    for group, members in grouped(rows, lambda row: group_of(row["scene"])).items():
        scenes = len({row["scene"] for row in members})
        name = " ".join(["mean of", str(scenes), *([group] if group else [])])
        for (keep, method), same in grouped(members, lambda row: (row["keep"], row["method"])).items():
            mean: Row = {"scene": name, "keep": keep, "method": method}
            for column in same[0].keys() - mean.keys():
                values = [row[column] for row in same if row[column] is not None]
                mean[column] = fmean(values) if values else None
            worst = min(same, key=lambda row: row["dense_psnr"])
            result.append(mean | {"worst": worst["dense_psnr"], "worst_scene": worst["scene"]})
    return result


def leads(
    rows: list[Row], method: str = MERGE, columns: tuple[str, ...] = PAIRS, rivals: tuple[str, ...] | None = None
) -> list[Row]:
    """How far a method is ahead, in dB, of the best of others at each scene and budget.

    Args:
        rows: one for each scene, budget and method.
        method: whose lead it is.
        columns: what they are compared by; the best of the others is chosen anew for each.
        rivals: the others; by default all modes of splat-transform.

    Returns:
        A row for each scene and budget that has both.
    """
    result = []
    for (scene, keep), same in grouped(rows, lambda row: (row["scene"], row["keep"])).items():
        ours = [row for row in same if row["method"] == method]
        peers = [row for row in same if (row["method"].startswith(NAME) if rivals is None else row["method"] in rivals)]
        lead: Row = {"scene": scene, "keep": keep}
        for column in columns:
            known = [row for row in peers if row[column] is not None]
            if ours and ours[0][column] is not None and known:
                best = max(known, key=lambda row: row[column])
                lead |= {column: ours[0][column] - best[column], f"{column}_peer": best["method"]}
        if len(lead) > 2:
            result.append(lead)
    return result


def summary(
    found: list[Row], column: str, together: bool = False
) -> Iterator[tuple[str, dict[float, float], dict[float, str]]]:
    """Lines of the table of leads: name, dB by budget, and what stands beside them.

    Each group of scenes is followed by its mean and by its least lead, with the scene that has it; if ``together``, the
    last lines tell these of all scenes of several groups.
    """
    groups = grouped(found, lambda lead: group_of(lead["scene"]))
    for group, members in groups.items():
        known = [lead for lead in members if column in lead]
        for scene, same in grouped(known, lambda lead: lead["scene"]).items():
            beside = {lead["keep"]: lead[f"{column}_peer"].removeprefix(NAME).strip() for lead in same}
            yield scene, {lead["keep"]: lead[column] for lead in same}, beside
        yield from _mean_and_worst(known, column, group)
    if together and len(groups) > 1:
        yield from _mean_and_worst([lead for lead in found if column in lead], column, "all")


def _mean_and_worst(
    known: list[Row], column: str, name: str
) -> Iterator[tuple[str, dict[float, float], dict[float, str]]]:
    """The last two lines of a group of scenes, in :func:`summary`; none if there is no lead."""
    budgets = grouped(known, lambda lead: lead["keep"])
    worst = {keep: min(same, key=lambda lead: lead[column]) for keep, same in budgets.items()}
    if known:
        yield f"{name} mean".strip(), {k: fmean(lead[column] for lead in same) for k, same in budgets.items()}, {}
        least = {keep: lead[column] for keep, lead in worst.items()}
        yield f"{name} worst".strip(), least, {keep: lead["scene"] for keep, lead in worst.items()}


AGAINST = {"dense_psnr": "the dense scene's renders", "photo_psnr": "held-out photos"}
"""What the PSNR of a column is against."""


def lead_table(found: list[Row], column: str, method: str = MERGE) -> Table | None:
    """The leads of a method over splat-transform as a table, None if there are none."""
    title = f"{method} minus the best mode of {NAME}, PSNR in dB against {AGAINST[column]}"
    return table_of_leads(list(summary(found, column)), title)


def table_of_leads(lines: list[tuple[str, dict[float, float], dict[float, str]]], title: str) -> Table | None:
    """Lines of :func:`summary` as a table, None if there are none."""
    if not lines:
        return None
    shown = Table(title=title)
    keeps = sorted({keep for _, values, _ in lines for keep in values}, reverse=True)
    shown.add_column("scene")
    for keep in keeps:
        shown.add_column(f"{100 * keep:g} %")
    for name, values, beside in lines:
        cells = [f"{values[keep]:+.2f} {beside.get(keep, '')}".strip() if keep in values else "-" for keep in keeps]
        shown.add_row(name, *cells, end_section=name.endswith("worst"))
    return shown


def number(digits: int, scale: float = 1.0, sign: str = "") -> Callable[[float], str]:
    """How a column writes its numbers: digits after the point, a factor first, and "+" for a sign always."""
    return lambda value: f"{scale * value:{sign},.{digits}f}"


SHOWN: dict[str, tuple[str, Callable[[Any], str]]] = {
    "count": ("splats", number(0)),
    "seconds": ("s", number(1)),
    "cpu_seconds": ("CPU s", number(1)),
    "peak_bytes": ("MB", number(0, 1e-6)),
    **{f"dense_{name}": (name.upper(), number(2 if name == "psnr" else 3)) for name in COLUMNS},
    **{name: (name.split("_")[1], number(2)) for name in HALVES},
    BRIGHTNESS: ("light", number(1, sign="+")),
    **{f"photo_{name}": (f"photo {name.upper()}", number(2 if name == "psnr" else 3)) for name in COLUMNS},
    "worst": ("worst", number(2)),
    "worst_scene": ("of", str),
}
"""Columns by what a row calls them: their heads, and how a value is written."""


def table(rows: list[Row]) -> Table:
    """Rows as a table; a dash for what cannot be had, no column for what none has."""
    shown = Table(title="against the dense scene's renders; light: mean change in 1/255; MB: peak memory; photos last")
    columns = [name for name in SHOWN if any(row.get(name) is not None for row in rows)]
    for name in ("scene", "kept", "method", *(SHOWN[column][0] for column in columns)):
        shown.add_column(name, justify="left" if name in ("scene", "method", "of") else "right")
    for (scene, keep), same in grouped(rows, lambda row: (row["scene"], row["keep"])).items():
        for row in same:
            start = [scene, f"{100 * keep:g} %"] if row is same[0] else ["", ""]
            cells = ["-" if row.get(name) is None else SHOWN[name][1](row[name]) for name in columns]
            shown.add_row(*start, row["method"], *cells, end_section=row is same[-1])
    return shown
