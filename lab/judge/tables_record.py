"""Writes docs/record/results.md and its figure from what ``python -m lab.tables`` measured.

    python -m lab.judge.tables_record docs/record/results.json

The table of encoders is of ``encoders.json`` beside the page, which refiners.py measured. ``prune``
and ``compact`` are left out: judge.py measures them, in views that no decision used.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import tyro

from lab.common.printing import markdown, start
from lab.judge import refiners
from lab.judge.record import FOLDER
from lab.tables.cells import Tables
from lab.tables.figure import plot_figure
from lab.tables.layout import Layout, Table, markdown_table
from lab.tables.ways import WAYS
from pointsplat_ns.system.files import replacing

SHOWN = (1, 3, 4)
"""Numbers of the tables that are shown: times need an idle machine, and Figure 4 shows its
medians."""

LEFT_OUT = (
    "SSIM",
    "PSNR (renders)",
    "SSIM (renders)",
    "LPIPS (renders)",
    "spread",
    "loses most",
    "scenes",
)
"""Columns that the page leaves to the measured rows."""

FIGURE = "results_figure4.png"

PAGE = """# The paper's networks and scores on four captures

`lab/judge/tables_record.py` writes this page from [results.json](results.json).
[`python -m lab.tables`](../tables.md) measured it on four [captures](../benchmarks.md#scenes) that no network and no
constant saw:

```bash
python -m lab.tables.networks captures -o networks --seeds 3 --steps 120
python -m lab.tables outputs/room35 outputs/phone outputs/can outputs/office -o results --views 5 --side 320 \\
    --scoring-views 12 --fine-tune 60 --refiners networks --groups captures=room35,phone,can,office
```

- Cells are PSNR (dB)/LPIPS (AlexNet) against held-out photos: means over the captures.
- Scenes and sizes are not the paper's:
  {sizes}.
- "made with": steps of fine-tuning, or encoder, size and steps of a network. Each network learned at the share of its
  column, on the six captures that tune, against dense renders, by the loss rmse + 0.05 LPIPS, at twelve times the
  usual rates; those of Table 4 three times (± standard deviation).
- The published trainings take 10,000 steps. After so few as here, rows II to V of Table 4 are above I and differ by no
  more than their spread: it does not support that gating and position help. Nor do 690 steps, on three captures:
  I 19.27, II 18.75 ± 0.22, III 18.91 ± 0.15, IV 18.81 ± 0.14, V 18.57 ± 0.22.
- \\*: nothing is fine-tuned or refined. "-" was not measured.
- Measured on {machines}.
"""

ENCODERS = """**Dual-branch against concatenating encoder, three seeds each**

`lab/judge/refiners.py` measured [encoders.json](encoders.json): the gain over the paper's selection in three unseen
scenes (apt_kitchen_balcony, pc_playbot, rock), 960 pixels wide, and its standard deviation over seeds. Networks learned
on fourteen scenes of 20,000 Gaussians:

```bash
ns-train pointsplat --data scenes --pipeline.datamanager.supervision dense --pipeline.datamanager.sampled-poses 24 \\
    --pipeline.datamanager.seed 0 --pipeline.model.encoder dual --pipeline.model.size tiny --pipeline.model.by paper \\
    --pipeline.model.keep 0.1 --pipeline.model.augment True --pipeline.model.pixel-loss rmse \\
    --pipeline.model.lpips-weight 0.05 --rate-factor 10 --max-num-iterations 250
```

{table}
"""


def read(path: Path) -> Tables:
    """The tables of a file that lab.tables wrote, without the cells of ``prune`` and
    ``compact``."""
    tables = Tables.of(json.loads(path.read_text("utf-8")))
    left_out = {WAYS.merge.name, WAYS.compact.name}
    tables.cells = {key: cell for key, cell in tables.cells.items() if cell["way"] not in left_out}
    return tables


def shortened(table: Table) -> Table:
    """A table without rows that were not measured, notes and :data:`LEFT_OUT`, with PSNR and LPIPS
    in one cell: Table 4 with the parts of each model and the spread; the others with a method's
    shares or lambdas side by side, and Table 1 with what each was made with, but for its share and
    loss."""
    rows = [
        dict(zip(table.header, row, strict=True)) for row in table.rows if "not measured" not in row
    ]
    parts = [name for name in table.header if name not in (*LEFT_OUT, "PSNR", "LPIPS", "made with")]
    if table.number == 4:
        header = ["model", "parts", "PSNR/LPIPS"]
        lines = []
        for row in rows:
            spread = "" if row["spread"] == "-" else f" ± {row['spread']}"
            used = ", ".join(name for name in parts[1:] if row[name])
            lines.append([row["model"], used, f"{row['PSNR']}{spread}/{row['LPIPS']}"])
        return dataclasses.replace(
            table, header=tuple(header), rows=[tuple(line) for line in lines], notes=[]
        )
    found = {tuple(row[name] for name in parts): row for row in rows}
    columns, methods = (list(dict.fromkeys(words[place] for words in found)) for place in (0, 1))
    header = [parts[1], *columns]
    lines = []
    for method in methods:
        own = {column: found[column, method] for column in columns if (column, method) in found}
        lines.append(
            [method, *(f"{own[c]['PSNR']}/{own[c]['LPIPS']}" if c in own else "-" for c in columns)]
        )
        if table.number == 1:  # networks of Table 3 are made like these
            lines[-1].append(
                "; ".join(
                    dict.fromkeys(row["made with"].partition(", keep")[0] for row in own.values())
                )
            )
    header += ["made with"] * (table.number == 1)
    return dataclasses.replace(
        table, header=tuple(header), rows=[tuple(line) for line in lines], notes=[]
    )


def page(tables: Tables, encoders: Path) -> str:
    """The page of all tables, that of encoders from the rows of a file of refiners.py."""
    abouts = list(tables.scenes.values())
    text = PAGE.format(
        sizes=", ".join(
            f"{about['width']} x {about['height']} ({about['name']})" for about in abouts
        ),
        machines="\n  and ".join(sorted({about["machine"] for about in abouts})),
    )
    layouts = [Layout(tables, group, names, ()) for group, names in tables.groups().items()]
    tables_shown = [table for each in layouts for table in each.tables() if table.number in SHOWN]
    shown = [
        markdown_table(table)
        for table in map(shortened, tables_shown)
        if len(table.rows) > (table.number == 4)
    ]
    figure = (
        f"![Opacity and volume]({FIGURE})\n\n*Figure 4: opacity and volume of the Gaussians kept.*"
    )
    compared = markdown(
        refiners.HEADS, refiners.lines(json.loads(encoders.read_text("utf-8"))["rows"])
    )
    return (
        "\n\n".join(
            part.strip() for part in (text, *shown, figure, ENCODERS.format(table=compared))
        )
        + "\n"
    )


def main(file: tyro.conf.Positional[Path], record: Path = FOLDER) -> None:
    """Write the record of the paper's tables.

    Args:
        file: tables.json of ``python -m lab.tables``.
        record: folder for results.md and its figure.
    """
    tables = read(file)
    with replacing(record / "results.md") as part:
        part.write_text(page(tables, record / "encoders.json"), "utf-8")
    plot_figure(tables.cells, tables.groups(), record / FIGURE)
    print(record / "results.md")


if __name__ == "__main__":
    start(main)
