"""Writes docs/record/results.md and its figure from what ``python -m lab.tables`` measured.

    python -m lab.judge.tables_record docs/record/results.json

The table of encoders is of ``encoders.json`` beside the page, which refiners.py measured. ``prune`` and ``compact`` are
left out: judge.py measures them, in views that no decision used.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import tyro

from lab.common.printing import markdown, start
from lab.judge import refiners
from lab.tables.cells import About, Cell
from lab.tables.layout import Layout, Table, figure_medians, markdown_table
from lab.tables.means import Group, SceneCells
from lab.tables.outputs import medians, plot_figure
from lab.tables.ways import WAYS
from pointsplat_ns.io.files import replacing
from pointsplat_ns.tradeoff.journal import restored_point

ROOT = Path(__file__).parents[2]

TABLES = (1, 3, 4)
"""Tables of quality. Table 2 has times, which need an idle machine."""

LEFT_OUT = ("PSNR (renders)", "SSIM (renders)", "LPIPS (renders)", "loses most")
"""Columns that the page leaves to the measured rows."""

FIGURE = "results_figure4.png"

PAGE = """# The paper's networks and scores on two rooms

`lab/judge/tables_record.py` writes this page from [results.json](results.json), which
[`python -m lab.tables`](../tables.md) measured on two rooms of `python -m lab.rooms`:

```bash
python -m lab.tables outputs/room52 outputs/room53 -o results --views 5 --side 320 --scoring-views 12 \\
    --fine-tune 60 --refiners refiners/dual-010 refiners/dual-030 refiners/concat-010 refiners/concat-030 \\
    --groups rooms=room52,room53
```

- Pictures are small: {sizes}. `prune` and `compact` are measured [at larger sizes](judge.md).
- The scenes are not of the paper's datasets. The paper's figures do not compare.
- Fine-tuning is 60 steps; the published baselines take thousands. The networks (size `small`) learned in 690 steps at
  most; the published ones learned far longer. Two seeds of one training can differ by more than the two networks do.
- PSNR (dB), SSIM and LPIPS (AlexNet) are means over scenes, against held-out photos.
- \\*: nothing is fine-tuned or refined.
- PUP-3DGS has no rows: its score was mended after these measurements. Networks have rows at the shares that they were
  trained for.
- Measured on {machines}.
"""

ENCODERS = """**Dual-branch against concatenating encoder, three seeds each**

The gain over the paper's selection in three scenes that no training saw (apt_kitchen_balcony, pc_playbot, rock), in
views written by hand, 960 pixels wide; `lab/judge/refiners.py` measured [encoders.json](encoders.json). The spread is
the standard deviation from seed to seed. Each network learned on fourteen scenes (ten splats, three captures, one
room), each merged to 20,000 Gaussians:

```bash
ns-train pointsplat --data scenes --pipeline.datamanager.supervision dense --pipeline.datamanager.sampled-poses 24 \\
    --pipeline.datamanager.seed 0 --pipeline.model.encoder dual --pipeline.model.size tiny --pipeline.model.by paper \\
    --pipeline.model.keep 0.1 --pipeline.model.augment True --pipeline.model.pixel-loss rmse \\
    --pipeline.model.lpips-weight 0.05 --rate-factor 10 --max-num-iterations 250
```

{table}
"""


def read(path: Path) -> list[Group]:
    """The groups of scenes of a file that lab.tables wrote, without the cells of ``prune`` and ``compact``.

    Raises:
        SystemExit: if the file cannot be read or is none.
    """
    left_out = {WAYS.merge.name, WAYS.compact.name}
    try:
        content = json.loads(path.read_text("utf-8"))
        cells = [_cell(values) for values in content["cells"] if values["way"] not in left_out]
        scenes: dict[str, list[SceneCells]] = {name: [] for name in content["groups"]}
        for about in (About(**values) for values in content["scenes"]):
            own = {(cell.way, cell.point.share): cell for cell in cells if cell.point.key.startswith(f"{about.name}/")}
            scenes[about.group].append(SceneCells(about, own))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SystemExit(
            f"{path}: cannot be read ({error!r}); expected tables.json of `python -m lab.tables`"
        ) from error
    return [Group(name, tuple(members)) for name, members in scenes.items()]


def _cell(values: dict[str, Any]) -> Cell:
    return Cell(**{**values, "point": restored_point(values["point"])})


def tables_of(group: Group) -> list[Table]:
    """The tables of a group, without rows that were not measured."""
    found = [_shortened(table) for table in Layout(group, (), {}).tables() if table.number in TABLES]
    if known := medians(group):
        found.append(figure_medians(group, known))
    return found


def _shortened(table: Table) -> Table:
    shown = [column for column, name in enumerate(table.header) if name not in LEFT_OUT]
    return dataclasses.replace(
        table,
        header=tuple(table.header[column] for column in shown),
        sections=tuple(
            tuple(tuple(row[column] for column in shown) for row in rows if "not measured" not in row)
            for rows in table.sections
        ),
        notes=(),
    )


def page(groups: list[Group], encoders: Path) -> str:
    """The page of all tables, that of encoders from the rows of a file of refiners.py."""
    abouts = [scene.about for group in groups for scene in group.scenes]
    text = PAGE.format(
        sizes=", ".join(f"{about.width} x {about.height} ({about.name})" for about in abouts),
        machines="; ".join(sorted({about.machine for about in abouts})),
    )
    tables = [markdown_table(table) for group in groups for table in tables_of(group)]
    figure = f"![Opacity and volume]({FIGURE})\n\n*Figure 4: opacity and volume of the Gaussians kept.*\n"
    compared = markdown(refiners.HEADS, refiners.lines(json.loads(encoders.read_text("utf-8"))["rows"]))
    return "\n".join([text, *tables, figure, ENCODERS.format(table=compared)])


def main(file: tyro.conf.Positional[Path], record: Path = ROOT / "docs" / "record") -> None:
    """Write the record of the paper's tables.

    Args:
        file: tables.json of ``python -m lab.tables``.
        record: folder for results.md and its figure.
    """
    groups = read(file)
    with replacing(record / "results.md") as part:
        part.write_text(page(groups, record / "encoders.json"), "utf-8")
    plot_figure(groups, record / FIGURE)
    print(record / "results.md")


if __name__ == "__main__":
    start(main)
