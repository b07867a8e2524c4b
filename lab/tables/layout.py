"""All cells of a folder, arranged as the paper's tables, in Markdown."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import pandas as pd

from lab.common.printing import markdown, number, percent
from lab.common.results import Row
from lab.tables.cells import FILES, Tables
from lab.tables.figure import medians, plot_figure, share_of_figure
from lab.tables.ways import PROTOCOL, PUBLISHED_METRICS, WAYS, Way, cell_key, published
from pointsplat_ns.system.files import replacing, three_digits

READING = (
    "Figures are means over the same scenes in all rows of a table, but for rows with a mark. "
    "PSNR (dB), SSIM and "
    'LPIPS (AlexNet and VGG) are against held-out photos; those of "renders" against the dense '
    "scene's own renders in the same poses. Networks of rows *unseen* saw other scenes only; those "
    "of rows *own photos* were trained on the training photos of the same scenes. Fill is the mean "
    'number of Gaussians that a viewer draws on a pixel. "Loses most" names the scene that loses most PSNR compared to its dense scene, '
    "with its PSNR and the difference; among dense scenes it is the one of the least PSNR. The "
    "spread is the standard deviation of PSNR over "
    "trainings that differ by their seed. \\*: nothing is fine-tuned or refined. Milliseconds "
    "are of CPU time, all threads together."
)

OTHER_SCENES = "†"
"""Mark of a row whose means are over other scenes than those of the table."""

WRITTEN = {"psnr": number(2), "ssim": number(3), "lpips": number(3), "lpips_vgg": number(3)}
"""How metrics are written."""

HEADS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "lpips_vgg": "LPIPS VGG"}
"""Their names in heads of tables."""

Cell = tuple[Way, float]
"""A way, and the share of the Gaussians kept."""


@dataclass(frozen=True)
class Table:
    """One of the paper's tables for one group of scenes."""

    number: int
    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: list[str]
    """Lines below the table: missing cells, and the reasons."""


class Layout:
    """Makes the tables of a group of scenes. ``keeps`` are the shares of Tables 1 and 2, to which
    those of measured cells are added."""

    def __init__(self, tables: Tables, group: str, names: Sequence[str], keeps: Sequence[float]):
        self.all = tables
        self.group = group
        self.names = names
        self.cells = {key: cell for key, cell in tables.cells.items() if key.split("/")[0] in names}
        of_table_1 = {way.name for way in WAYS.table_1} - {
            way.name for way in WAYS.table_4
        }  # Table 4 has other shares
        measured = {
            cell["point"]["share"] for cell in self.cells.values() if cell["way"] in of_table_1
        }
        self.shares = sorted({*keeps, *measured}, reverse=True)
        self.frame = pd.DataFrame([_flat(key, cell) for key, cell in self.cells.items()])
        self.frame = self.frame.set_index(["way", "share", "scene"]).sort_index()
        dense = (
            self.frame["photos_psnr"].xs(("dense", 1.0))
            if ("dense", 1.0) in self.frame.index
            else pd.Series()
        )
        self.frame["lost"] = (
            self.frame.index.get_level_values("scene").map(dense) - self.frame["photos_psnr"]
        )
        self.has_photos = bool(self.frame["photos_psnr"].notna().any())

    def tables(self) -> list[Table]:
        """Tables 1 to 4, and the medians of Figure 4 where it has any."""
        every = [
            (WAYS.dense, 1.0),
            *((way, share) for share in self.shares for way in WAYS.table_1),
        ]
        few = [(way, share) for way, share in every if way == WAYS.dense or way in WAYS.table_2]
        share = PROTOCOL.ablation_share
        lambdas = [((f"{weight:g}", way.label), way, share) for weight, way in WAYS.table_3]
        branches = (
            ("", "", ""),
            ("yes", "", ""),
            ("yes", "", "yes"),
            ("yes", "yes", ""),
            ("yes", "yes", "yes"),
        )
        models = dict(zip(("I", "II", "III", "IV", "V"), branches, strict=True))
        first_row, *refined = WAYS.table_4
        names = ["I", *(name for name in [*models][1:] for _ in WAYS.pointsplat.protocols)]
        parts = [
            ((name, *models[name], way.saw), way, share)
            for name, way in zip(names, (first_row, *refined), strict=True)
        ]
        first = ("kept", "method")
        return [
            self._quality(
                1, "What is left at a number of Gaussians", first, list(map(_named, every))
            ),
            self._efficiency(first, list(map(_named, few))),
            self._quality(
                3,
                f"Lambda of the paper's score, {percent(share)} kept",
                ("lambda", "method"),
                lambdas,
            ),
            self._quality(
                4,
                f"The dual-branch encoder, {percent(share)} kept",
                ("model", "geometry", "appearance", "position", "network saw"),
                parts,
            ),
            *self._medians(),
        ]

    def _quality(self, which: int, title: str, first: tuple[str, ...], rows: list[tuple]) -> Table:
        """A table of PSNR, SSIM, LPIPS, with the paper's figures where dataset and protocol are the
        paper's. LPIPS against renders is measured where there are no photos."""
        dataset = self.all.comparable(self.names)
        cells = [(way, share) for _, way, share in rows]
        theirs = {cell: published(which, dataset, cell[0].name, cell[1]) for cell in cells}
        shown = [("renders", name) for name in WRITTEN]
        if self.has_photos:
            shown = [("photos", name) for name in WRITTEN] + shown[:2]
        heads = [HEADS[name] + " (renders)" * (kind == "renders") for kind, name in shown]
        spread = ["spread"] * (which == 4)
        paper = [f"{HEADS[name]} (paper)" for name in PUBLISHED_METRICS] * any(theirs.values())
        heads += [*spread, "loses most", "made with", "scenes", *paper]

        def figures(same: pd.DataFrame, mean: pd.Series) -> list[str]:
            found = [_text(WRITTEN[name], mean[f"{kind}_{name}"]) for kind, name in shown]
            found += [_spread(same)] * (which == 4)
            return [*found, _worst(same), ", ".join(dict.fromkeys(map(_made, same["made_with"])))]

        def more(cell: Cell) -> list[str]:
            known = theirs[cell] or (None,) * len(PUBLISHED_METRICS)
            return [
                _text(WRITTEN[name], value)
                for name, value in zip(PUBLISHED_METRICS, known, strict=True)
            ]

        return self._table(
            which, title, first, heads, rows, figures, more if any(theirs.values()) else None
        )

    def _efficiency(self, first: tuple[str, ...], rows: list[tuple]) -> Table:
        def figures(same: pd.DataFrame, mean: pd.Series) -> list[str]:
            costs = [
                _text(number(1), mean[name]) for name in ("frame_ms", "frame_ms_torch", "fill")
            ]
            return [f"{mean['gaussians']:,.0f}", three_digits(mean["bytes"] / 1e6), *costs]

        return self._table(
            2,
            "Efficiency",
            first,
            ["Gaussians", "MB", "CPU ms a frame", "torch alone", "fill", "scenes"],
            rows,
            figures,
            None,
        )

    def _table(self, which, title, first, heads, rows, figures, more) -> Table:
        """A table of rows: their first words, way and share.

        Args:
            which: number of the table.
            title: what it is of.
            first: heads of the first words.
            heads: heads of what follows.
            rows: first words, way and share of each.
            figures: texts of a row's cells, from the cells of its scenes and their means.
            more: texts of further cells, from way and share; None for none.
        """
        scenes = {}
        for _, way, share in rows:
            known = (way.name, share) in self.frame.index
            scenes[way, share] = (
                frozenset(self.frame.loc[way.name, share].index) if known else frozenset()
            )
        counts = Counter(names for names in scenes.values() if names)
        over = max(
            counts,
            key=lambda names: (counts[names], len(names), sorted(names)),
            default=frozenset(),
        )
        lines = []
        marked = False
        for words, way, share in rows:
            names = scenes[way, share]
            if not names:
                extra = len(PUBLISHED_METRICS) * (more is not None)
                cells = ["not measured"] + ["-"] * (len(heads) - 1 - extra)
            else:
                comparable = over <= names
                same = self.frame.loc[way.name, share].loc[sorted(over if comparable else names)]
                marked |= not comparable
                mean = same.mean(numeric_only=True, skipna=False)
                cells = [
                    *figures(same, mean),
                    f"{len(same)}" + f" {OTHER_SCENES}" * (not comparable),
                ]
            lines.append((*words, *cells, *(more((way, share)) if more else ())))
        notes = []
        if marked:
            notes = [
                f"{OTHER_SCENES}: not over the scenes of the other rows ({', '.join(sorted(over))})"
            ]
        title = f"{title}: {self.group}, {len(over)} scene{'s' * (len(over) != 1)}"
        return Table(
            which,
            title,
            (*first, *heads),
            lines,
            notes + self._notes([(way, share) for _, way, share in rows]),
        )

    def _notes(self, cells: list[Cell]) -> list[str]:
        """Reasons for missing cells, each once."""
        found: dict[str, dict[str, None]] = {}
        for way, share in cells:
            for name in self.names:
                if (key := cell_key(name, way, share)) not in self.cells:
                    label = f"{way.label} ({percent(share)})"
                    why = self.all.missing.get(key, "not yet")
                    found.setdefault(why, {})[
                        label if len(self.names) == 1 else f"{label} on {name}"
                    ] = None
        return [f"Not measured, {why}: {', '.join(labels)}" for why, labels in found.items()]

    def _medians(self) -> list[Table]:
        found = medians(self.cells, list(self.names))
        title = (
            f"Medians of Figure 4: {self.group}, "
            f"{percent(share_of_figure(self.cells, list(self.names)))} kept"
        )
        rows = [
            (way.label, f"{found[way.name][0]:.2f}", f"{found[way.name][1]:.1f}")
            for way in WAYS.figure_4
            if way.name in found
        ]
        return (
            [Table(0, title, ("method", "opacity", "log10 of the volume"), rows, [])]
            if rows
            else []
        )


def _named(cell: Cell) -> tuple[tuple[str, str], Way, float]:
    way, share = cell
    return (percent(share), way.label), way, share


def _flat(key: str, cell: Row) -> Row:
    """A cell's figures in one level."""
    point = cell["point"]
    row = {
        "scene": key.split("/")[0],
        "way": cell["way"],
        **{n: point[n] for n in ("share", "gaussians", "bytes")},
    }
    for kind, target in (("renders", "against_dense"), ("photos", "against_photos")):
        found = point[target] or {}
        row |= {
            f"{kind}_{name}": float("nan") if (v := found.get(name)) is None else v
            for name in WRITTEN
        }
    costs = {
        name: float("nan") if (v := point.get(name)) is None else v
        for name in ("frame_ms", "frame_ms_torch", "fill")
    }
    return row | costs | {"trainings": cell.get("psnr", []), "made_with": cell["made_with"]}


def _text(write: Any, value: float | None) -> str:
    return "-" if value is None or pd.isna(value) else write(value)


_TRAINED = re.compile(
    r"(\w+) encoder.*?keep ([^;)]+).*?size (\w+), steps ([^,;)]+).*?pixel loss (\w+), lpips weight ([\d.]+)"
)


def _made(made_with: str) -> str:
    """Encoder, size, steps, budget and loss of the networks that a cell was made with; or its first
    words."""
    if (found := _TRAINED.search(made_with)) is None:
        return made_with.split(" (")[0]
    encoder, keep, size, steps, loss, weight = found.groups()
    return f"{encoder} {size}, {steps} steps, keep {keep}, {loss} + {weight} LPIPS"


def _spread(same: pd.DataFrame) -> str:
    """Standard deviation over trainings of the mean PSNR of scenes; a dash for one training."""
    trainings = list(zip(*same["trainings"], strict=False))
    return f"{stdev(map(fmean, trainings)):.2f}" if len(trainings) > 1 else "-"


def _worst(same: pd.DataFrame) -> str:
    """The scene that loses most, or that has the least PSNR where that is not known; with its PSNR
    and the loss."""
    psnr = same["photos_psnr"].fillna(same["renders_psnr"])
    if psnr.isna().any():
        return "-"
    order = pd.DataFrame({"lost": same["lost"].fillna(-psnr), "low": -psnr}).sort_values(
        ["lost", "low"]
    )
    name = order.index[-1]
    lost = same["lost"][order.index[-1]]
    return f"{name} {psnr[name]:.2f}" + (f" ({-lost:+.2f})" if lost and not pd.isna(lost) else "")


def escaped(text: str) -> str:
    """Text with Markdown's special characters escaped, in one line.

    Example:
        >>> print(escaped("PointSplat* of room_1"))
        PointSplat\\* of room\\_1
    """
    return re.sub(r"([\\`*_{}\[\]<>#|~])", r"\\\1", " ".join(text.split()))


def markdown_table(table: Table) -> str:
    """A table in Markdown, with its title above and its notes below."""
    name = f"Table {table.number}. " if table.number else ""
    header, *rows = (list(map(escaped, row)) for row in (table.header, *table.rows))
    notes = "\n".join(f"- {escaped(note)}" for note in table.notes)
    return "\n\n".join(
        [f"**{name}{escaped(table.title)}**", markdown(header, rows), *([notes] if notes else [])]
    )


def write_tables(tables: Tables, folder: Path, keeps: Sequence[float]) -> None:
    """Write all files, if anything was measured. ``keeps`` are the shares of Table 1, for rows
    without measurements."""
    if not tables.cells:
        return
    tables.save(folder)
    groups = tables.groups()
    made = {group: Layout(tables, group, names, keeps).tables() for group, names in groups.items()}
    with replacing(folder / FILES[1], named=False) as part:
        part.write_text(_markdown(tables, made), encoding="utf-8")
    plot_figure(tables.cells, groups, folder / FILES[2])


def _markdown(tables: Tables, made_tables: dict[str, list[Table]]) -> str:
    machines = sorted({tables.scenes[key.split("/")[0]]["machine"] for key in tables.cells})
    made = sorted(
        {
            f"{cell['version']}, commit {cell['commit'] or 'unknown'}"
            for cell in tables.cells.values()
        }
    )
    parts = [
        READING,
        escaped(f"Measured on {'; '.join(machines)}, by pointsplat_ns {'; '.join(made)}."),
    ]
    for group, names in tables.groups().items():
        heads = ["scene", "Gaussians", "judged in", "size", "differs from the paper in"]
        lines = []
        for about in map(tables.scenes.__getitem__, names):
            dense = tables.cells.get(cell_key(about["name"], WAYS.dense, 1.0))
            count = f"{dense['point']['gaussians']:,}" if dense else "-"
            size = f"{about['width']} x {about['height']}"
            line = (
                about["name"],
                count,
                f"{about['views']} {about['origin']}",
                size,
                about.get("differs", ""),
            )
            lines.append(list(map(escaped, line)))
        if tables.dataset(names) and tables.comparable(names):
            parts_of_paper = (
                "The paper does not say of which scenes its Table 2 and Figure 4 are, nor by which "
                "network its LPIPS is; the released code takes VGG."
            )
            parts.append(parts_of_paper)
        parts += [
            f"## {escaped(group)}",
            markdown(heads, lines),
            *map(markdown_table, made_tables[group]),
        ]
    parts += [f"![Figure 4]({FILES[2]})", "*Figure 4: opacity and volume of the Gaussians kept.*"]
    return "\n\n".join(part.strip() for part in parts) + "\n"
