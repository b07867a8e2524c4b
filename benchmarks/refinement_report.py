"""Tables, gains with their spread over seeds, and targets of the refinement benchmark."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table as RichTable

from pointsplat_ns.errors import PointSplatError

REFERENCES = ("photo", "dense")
ENCODERS = ("concat", "dual")
PLAIN = ("selected", "fine-tuned", "fine-tuned on photos")
SHIPPED = "as shipped"
"""Refined by the dual-branch network as far as the rule of ``pointsplat compact`` refines."""

UNSEEN = "unseen"
GAIN_TARGETS = (("paper", 0.1, 2.0), ("paper", 0.3, 1.0), ("merge", 0.1, 0.7))
"""Start, share kept, dB that refined must beat selected by on unseen scenes."""

WORST = -0.1
"""dB; no refined scene may be worse than what it started from by more."""

RESOLVED = 2.0
"""Standard errors over seeds from which on a difference counts as more than chance."""

SMALLEST_SPREAD = 1e-9
"""Below it seeds agree exactly, and no number of standard errors can be given."""

BySeed = dict[Any, dict[str, float]]
"""By seed (None for what has none) and scene: a value."""


def read_files(files: Sequence[Path]) -> tuple[list[dict], dict[str, Any]]:
    """The rows of all files, and the settings that they share; of rows in more than one file the last counts.

    Raises:
        PointSplatError: if a file is not there, or files were made with different settings.
    """
    rows: dict[tuple, dict] = {}
    settings: dict[str, Any] | None = None
    for path in files:
        try:
            content = json.loads(path.read_text("utf-8"))
            found = content["rows"]
            settings = content["settings"] if settings is None else settings
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise PointSplatError(f"{path}: not a file of rows ({error}); expected what evaluate wrote") from error
        if content["settings"] != settings:
            raise PointSplatError(f"{path}: made with {content['settings']}, {files[0]} with {settings}")
        for row in found:
            rows[tuple(row[name] for name in ("scene", "keep", "start", "variant", "seed"))] = row
    if not rows:
        raise PointSplatError("no row in any file; run evaluate first")
    return list(rows.values()), settings or {}


class Table:
    """Rows by what they are of."""

    def __init__(self, rows: Iterable[dict]):
        self.rows = list(rows)
        self._by: dict[tuple, dict[Any, dict[str, dict]]] = {}
        for row in self.rows:
            of = self._by.setdefault((row["keep"], row["start"], row["variant"]), {})
            of.setdefault(row["seed"], {})[row["scene"]] = row
        self.scenes = sorted({row["scene"] for row in self.rows})
        self.keeps = sorted({row["keep"] for row in self.rows if row["variant"] != "dense"}, reverse=True)
        self.starts = [s for s in ("paper", "merge") if any(row["start"] == s for row in self.rows)]

    def values(self, scenes: Iterable[str], keep: float, start: str, variant: str, metric: str) -> BySeed:
        """A metric of a variant."""
        wanted = set(scenes)
        result: BySeed = {}
        for seed, by_scene in self._by.get((keep, start, variant), {}).items():
            for scene in wanted & by_scene.keys():
                if by_scene[scene].get(metric) is not None:
                    result.setdefault(seed, {})[scene] = by_scene[scene][metric]
        return result


def difference(left: BySeed, right: BySeed) -> BySeed:
    """``left`` minus ``right``, of the same seed and scene; what has no seed is taken from every seed."""
    result: BySeed = {}
    for seed, values in left.items():
        other = right.get(seed, right.get(None, {}))
        for scene in values.keys() & other.keys():
            result.setdefault(seed, {})[scene] = values[scene] - other[scene]
    return result


@dataclass(frozen=True)
class Spread:
    """Means over scenes, one a seed, and how they scatter."""

    per_seed: dict[Any, float]
    scenes: int  # that every seed has; others are left out
    smallest: float
    smallest_at: tuple[str, Any]  # scene and seed

    @property
    def mean(self) -> float:
        return statistics.fmean(self.per_seed.values())

    @property
    def deviation(self) -> float | None:
        """Standard deviation over seeds (n - 1); None for fewer than two."""
        return statistics.stdev(self.per_seed.values()) if len(self.per_seed) > 1 else None

    @property
    def error(self) -> float | None:
        """Standard error of the mean over seeds."""
        return None if self.deviation is None else self.deviation / len(self.per_seed) ** 0.5


def spread(values: BySeed) -> Spread | None:
    """Over the scenes that every seed has, so that no seed is judged by easier scenes; None if there is none."""
    if not values:
        return None
    shared = set.intersection(*(set(by_scene) for by_scene in values.values()))
    if not shared:
        return None
    every = [(value, scene, seed) for seed, by in values.items() for scene, value in by.items()]
    smallest, scene, seed = min(every, key=lambda entry: entry[0])
    means = {seed: statistics.fmean(by[name] for name in sorted(shared)) for seed, by in values.items()}
    return Spread(means, len(shared), smallest, (scene, seed))


def joined(parts: dict[float, BySeed]) -> BySeed:
    """Several budgets as one, each scene at each budget a scene of its own; seeds that all budgets have."""
    present = [by for by in parts.values() if by]
    seeds = set.intersection(*(set(by) for by in present)) if present else set()
    return {
        seed: {f"{scene} {100 * keep:g} %": v for keep, by in parts.items() if by for scene, v in by[seed].items()}
        for seed in sorted(seeds, key=str)
    }


def default_groups(rows: list[dict]) -> dict[str, list[str]]:
    """Scenes that no refiner was trained on, and the others."""
    seen = {row["scene"] for row in rows if row.get("seen")}
    groups = {UNSEEN: sorted({row["scene"] for row in rows} - seen), "seen": sorted(seen)}
    return {name: scenes for name, scenes in groups.items() if scenes}


def parse_groups(groups: Sequence[str], table: Table) -> dict[str, list[str]]:
    """Groups from NAME=SCENE,SCENE; scenes that are not in the files are named and left out.

    Raises:
        PointSplatError: if one is written otherwise or has no scene in the files.
    """
    result = {}
    for group in groups:
        name, equals, scenes = group.partition("=")
        wanted = [scene for scene in scenes.split(",") if scene]
        present = [scene for scene in wanted if scene in table.scenes]
        if not equals or not present:
            raise PointSplatError(f"--groups {group}: no such scene; expected NAME=SCENE,... of {table.scenes}")
        if len(present) < len(wanted):
            print(f"{name}: not in the files: {', '.join(s for s in wanted if s not in present)}")
        result[name] = present
    return result


def judge(table: Table, groups: dict[str, list[str]]) -> list[tuple[str, str]]:
    """Each target: what was found, and the verdict."""
    group = UNSEEN if UNSEEN in groups else next(iter(groups))
    scenes = groups[group]
    lines = []
    for start, keep, wanted in GAIN_TARGETS:
        what = f"{group}, {start} at {100 * keep:g} %: dual beats selected by {wanted:g} dB"
        gain = spread(gains(table, scenes, keep, start, "dual", "photo_psnr"))
        dense = spread(gains(table, scenes, keep, start, "dual", "dense_psnr"))
        if gain is None:
            lines.append((what, "no data"))
            continue
        verdict = ("met by " if gain.mean >= wanted else "MISSED by ") + f"{abs(gain.mean - wanted):.2f} dB"
        lines.append(
            (what, f"{verdict}: {_text(gain, len(scenes))}; against dense renders {_text(dense, len(scenes))}")
        )
    for start in table.starts:
        budgets: dict[str, float | None] = {f"at {100 * k:g} %": k for k in table.keeps} | {"over all shares": None}
        for name, keep in budgets.items():
            found = [
                spread(versus_concat(table, scenes, (keep,) if keep else table.keeps, start, f"{against}_psnr"))
                for against in REFERENCES
            ]
            what = f"{group}, {start} {name}: dual beats concat"
            lines.append((what, f"{_resolved(found[0])}; against dense renders {_resolved(found[1])}"))
    everywhere = sorted({scene for of in groups.values() for scene in of})
    for variant in ("dual", SHIPPED, "concat"):
        what = f"all groups: {variant} nowhere worse than selected by more than {-WORST:g} dB"
        lines.append((what, "; ".join(_nowhere(table, everywhere, variant, against) for against in REFERENCES)))
    return lines


def gains(table: Table, scenes: Iterable[str], keep: float, start: str, variant: str, metric: str) -> BySeed:
    """What a variant has over what it started from."""
    selected = table.values(scenes, keep, start, "selected", metric)
    return difference(table.values(scenes, keep, start, variant, metric), selected)


def versus_concat(table: Table, scenes: Iterable[str], keeps: Iterable[float], start: str, metric: str) -> BySeed:
    """Dual minus concat, paired by seed, scene and share kept."""
    pairs = {}
    for keep in keeps:
        dual, concat = (table.values(scenes, keep, start, encoder, metric) for encoder in ("dual", "concat"))
        pairs[keep] = difference(dual, concat)
    return joined(pairs)


def _resolved(found: Spread | None) -> str:
    if found is None:
        return "no data"
    text = f"{found.mean:+.3f} dB"
    if found.error is None:
        return f"{'positive' if found.mean > 0 else 'MISSED'}, one seed alone: {text}"
    if found.error < SMALLEST_SPREAD:
        return f"{'met' if found.mean > 0 else 'MISSED'}: {text}, no spread over {len(found.per_seed)} seeds"
    errors = found.mean / found.error
    verdict = "met" if errors >= RESOLVED else "MISSED" if errors <= -RESOLVED else "UNDECIDED"
    positive = f"positive in {sum(value > 0 for value in found.per_seed.values())} of {len(found.per_seed)} seeds"
    return f"{verdict}: {text}, {errors:+.1f} standard errors of {found.error:.3f} dB, {positive}"


def _nowhere(table: Table, scenes: list[str], variant: str, against: str) -> str:
    """Over every scene, share, start and seed."""
    found, out = [], 0
    for keep in table.keeps:
        for start in table.starts:
            values = gains(table, scenes, keep, start, variant, f"{against}_psnr")
            found += [(v, f"{s} {start} {100 * keep:g} % seed {n}") for n, by in values.items() for s, v in by.items()]
            strengths = table.values(scenes, keep, start, variant, "strength")
            out += sum(value == 0 for by in strengths.values() for value in by.values())
    if not found:
        return "no data"
    worst, where = min(found)
    below = sum(value < WORST for value, _ in found)
    verdict = "met" if below == 0 else f"MISSED by {WORST - worst:.2f} dB, {below} of {len(found)} cases below"
    fell = f", {out} of {len(found)} fall back" if variant == SHIPPED else ""
    head = "" if against == "photo" else "against dense renders "
    return f"{head}{verdict} (worst {worst:+.2f} dB: {where}{fell})"


def _text(found: Spread | None, scenes: int) -> str:
    if found is None:
        return "no data"
    seeds = f"{len(found.per_seed)} seed{'s' if len(found.per_seed) > 1 else ''}"
    of = f"{found.scenes} of {scenes} scene{'s' if scenes > 1 else ''}"
    scene, seed = found.smallest_at
    return f"{_number(found, 2, sign=True)} dB ({seeds}, {of}; smallest {found.smallest:+.2f}: {scene} seed {seed})"


def _number(found: Spread | None, digits: int, sign: bool = False) -> str:
    if found is None:
        return "-"
    text = f"{found.mean:{'+' if sign else ''}.{digits}f}"
    return text if found.deviation is None else f"{text} ± {found.deviation:.{digits}f}"


COLUMNS = (
    *(
        (f"{against} {name.upper()}", f"{against}_{name}", 2 if name == "psnr" else 3)
        for against in REFERENCES
        for name in ("psnr", "ssim", "lpips")
    ),
    ("select s", "select_seconds", 2),
    ("repair s", "seconds", 1),
    ("Gaussians", "count", 0),
    ("MB", "megabytes", 2),
)


def main_table(table: Table, scenes: list[str], tune: int) -> list[list[str]]:
    """Cells of one group: a row for each share, start and variant."""
    lines = [["100 %", "dense", *_cells(table, scenes, 1.0, "", "dense")]]
    for keep in table.keeps:
        for start in table.starts:
            names = ["selected", *ENCODERS, SHIPPED, *PLAIN[1:]]
            for variant in names:
                if not table.values(scenes, keep, start, variant, "count"):
                    continue
                name = start if variant == "selected" else f"{start} + {variant}"
                if variant in PLAIN[1:]:
                    name += f" {tune} steps"
                lines.append([f"{100 * keep:g} %", name, *_cells(table, scenes, keep, start, variant)])
    return lines


def _cells(table: Table, scenes: list[str], keep: float, start: str, variant: str) -> list[str]:
    found = [(spread(table.values(scenes, keep, start, variant, metric)), digits) for _, metric, digits in COLUMNS]
    cells = [_number(value, digits) for value, digits in found[:6]]
    cells += ["-" if value is None else f"{value.mean:,.{digits}f}" for value, digits in found[6:]]
    counts = found[-1][0]
    return [*cells, f"{counts.scenes if counts else 0}/{len(scenes)}"]


def gain_table(table: Table, groups: dict[str, list[str]]) -> list[list[str]]:
    """Cells: what every encoder gains over what it started from, and dual over concat."""
    lines = []
    for group, scenes in groups.items():
        for keep in table.keeps:
            for start in table.starts:
                cells = [group, f"{100 * keep:g} %", start]
                for against in REFERENCES:
                    metric = f"{against}_psnr"
                    for variant in (*ENCODERS, SHIPPED):
                        cells.append(_number(spread(gains(table, scenes, keep, start, variant, metric)), 2, True))
                    cells.append(_number(spread(versus_concat(table, scenes, (keep,), start, metric)), 3, True))
                for variant in ("dual", SHIPPED):
                    found = spread(gains(table, scenes, keep, start, variant, "photo_psnr"))
                    cells.append("-" if found is None else f"{found.smallest:+.2f} {found.smallest_at[0]}")
                lines.append(cells)
    return lines


def print_report(table: Table, groups: dict[str, list[str]], settings: dict[str, Any], markdown: bool) -> None:
    """Everything, for a terminal; Markdown after each table if asked for."""
    console = Console(width=None if Console().is_terminal else 230)
    show: Callable[..., None] = lambda *a: _show(console, markdown, *a)  # noqa: E731
    heads = ["kept", "variant", *(name for name, _, _ in COLUMNS), "scenes"]
    tune = settings.get("fine_tune", 0)
    for line in trainings(table.rows):
        console.print(line, highlight=False)
    for group, scenes in groups.items():
        note = "means over scenes; ± is the standard deviation over seeds; fine-tuning is against dense renders"
        show(f"{group} ({', '.join(scenes)}): {note}", heads, main_table(table, scenes, tune))
    heads = ["group", "kept", "start"]
    for against in REFERENCES:
        heads += [f"{against}: {name}" for name in (*ENCODERS, SHIPPED, "dual - concat")]
    heads += ["smallest dual", "smallest shipped"]
    show("Gains in PSNR over what was selected, dB", heads, gain_table(table, groups))
    console.print("Targets, by PSNR against held-out photos:", style="bold")
    for what, verdict in judge(table, groups):
        console.print(f"- {what}: {verdict}", highlight=False, soft_wrap=True)


def trainings(rows: Iterable[dict]) -> list[str]:
    """A line for each kind of refiner: seeds, steps and supervision; kinds of unlike steps are told apart by them."""
    kinds: dict[tuple, set] = {}
    for row in rows:
        if row["variant"] in ENCODERS:
            kinds.setdefault((row["start"], row["variant"], row["steps"], row["supervision"]), set()).add(row["seed"])
    return [
        f"{start} + {encoder}: seeds {', '.join(map(str, sorted(seeds)))}; {steps:,} steps; supervision {by}"
        for (start, encoder, steps, by), seeds in sorted(kinds.items())
    ]


def _show(console: Console, markdown: bool, title: str, heads: list[str], lines: list[list[str]]) -> None:
    shown = RichTable(title=title)
    for index, head in enumerate(heads):
        shown.add_column(head, justify="left" if index < 2 else "right")
    before = None
    for line in lines:
        if before not in (None, line[0]):
            shown.add_section()
        before = line[0]
        shown.add_row(*line)
    console.print(shown)
    if markdown:
        text = [f"{title}\n", f"| {' | '.join(heads)} |", "|---|---|" + "---:|" * (len(heads) - 2)]
        print("\n".join(text + [f"| {' | '.join(line)} |" for line in lines]) + "\n")
