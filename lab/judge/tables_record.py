"""Writes docs/record/results.md, its figures and the times in docs/tables.md from what ``python -m
lab.tables`` measured.

    python -m lab.judge.tables_record docs/record/results.json docs/record/results_320.json

Several files are the same captures at several sizes, the most trustworthy first. What one of them
lacks is taken from the next.

The table of encoders is of ``encoders.json`` beside the page, which refiners.py measured, and the
row of Replica of ``replica.json``, which replica_row.py wrote.
"""

from __future__ import annotations

import dataclasses
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import tyro

from lab.common.printing import markdown, number, put_between, start, wrapped
from lab.common.results import Row
from lab.judge import encoders
from lab.judge.record import FOLDER, ROOT
from lab.tables import sources
from lab.tables.cells import Tables
from lab.tables.curves import TUNED, last_gain, mean_curve, plot_curves
from lab.tables.figure import plot_figure
from lab.tables.findings import CLAIMS, OURS, outcomes, paragraph
from lab.tables.layout import HEADS, WRITTEN, Layout, Table, escaped, markdown_table
from lab.tables.replica_row import section
from lab.tables.ways import PROTOCOL, WAYS, Way, cell_key
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.files import replacing

MAIN = "captures"
"""The group of scenes that the finding and the figures are of."""

LEFT_OUT = ("PSNR (renders)", "SSIM (renders)", "spread", "loses most", "scenes")
"""Columns that the page leaves to the measured rows."""

FIGURE = "results_figure4.png"

CURVES = "results_curves.png"

EXAMPLE = "room35"
"""The scene whose cells the page shows how to measure again."""

ENCODERS_FILE = "encoders.json"

REPLICA_FILE = "replica.json"

TIMES = "times"
"""Name of the marks around the table of times."""

PAGE = """# The paper's tables on {count} captures

{findings}

A difference is a mean over the captures ± its standard deviation over them, at 10 % of the Gaussians: of PSNR in
held-out photos, or in percent how much lower LPIPS is, or how much less is drawn or waited for. A claim holds, or does
not, if the mean is beyond that spread.

## How it was measured

`lab/judge/tables_record.py` writes this page from
{files}, which
[`python -m lab.tables`](../tables.md) measured on [captures](../benchmarks.md#scenes) that no constant was chosen on.
In a clone, with its kernels built (`python setup.py build_ext --inplace`), this makes a dense scene and measures one
cell of each table, those below. Other cells are named in the same way; the files have all:

```bash
python -m lab.judge.captures room35 clone captures/room35
ns-train splatfacto-cpu --output-dir outputs --experiment-name room35 --max-num-iterations 2000 --data captures/room35 \\
    nerfstudio-data --eval-mode interval --eval-interval 8
{commands}
```

{examples}

The scenes:

{scenes}

- Protocols of rows with a network: *unseen*, the network saw other scenes only; *own photos*, it was trained on the
  training photos of these captures, and other photos are held out. The program refuses any other weights. In full
  size, *unseen* is the refiner that ships for selections, and *own photos* continues from it for 50 minutes of a core
  that other programs shared:
  `ns-train pointsplat --data outputs --init shipped --pipeline.model.keep 10% --seconds 3000`. At 320 pixels networks
  were trained by `python -m lab.tables.networks captures -o networks --seeds 3 --steps 120`, and the dense scenes
  are other trainings of the same captures.
- PSNR is in dB. LPIPS is by AlexNet, LPIPS VGG by VGG. "-" was not measured.
- \\*: nothing is fine-tuned or refined.
- "made with": steps of fine-tuning, or encoder, size, steps, share and loss of the network.
- CPU ms a frame: of one thread, by compiled kernels, and by torch alone (at 320 pixels on the clock). None of these rows
  was drawn on a GPU, which `python -m lab.speed.cuda` times. Fill: Gaussians that a viewer draws on a pixel.
- Measured on {machines}.
"""

SETTINGS = """## Cited or unknown

The released code is [anhthuan1999/pointsplat](https://github.com/anhthuan1999/pointsplat), as of commit 6d093b9.

{table}

Hours of the published training on a GPU are unknown: no step of it was measured there. On one thread of a CPU a step on
two views of 320 pixels and 5,757 Gaussians takes 0.30 s for the size `tiny` and 0.67 s for `small`, so 10,000 steps take
about 0.8 and 1.9 hours; the published network has the size `full`. `python -m lab.speed.training RUN --refiner` measures
steps.
"""


def read(path: Path) -> Tables:
    """The tables of a file that lab.tables wrote."""
    content = json.loads(path.read_text("utf-8"))
    tables = Tables.of(content)
    tables.missing = dict(content.get("not_measured", {}))
    return tables


def shortened(table: Table) -> Table:
    """A table without rows that were not measured, which a note names; without columns that have no
    figures, and :data:`LEFT_OUT`."""
    rows = [
        dict(zip(table.header, row, strict=True)) for row in table.rows if "not measured" not in row
    ]
    header = [
        name
        for name in table.header
        if name not in LEFT_OUT and any(row[name] not in ("", "-") for row in rows)
    ]
    if table.number == 4 and any(row["spread"] != "-" for row in rows):
        header.insert(header.index("PSNR") + 1, "spread")
    lines = [tuple(row[name] for name in header) for row in rows]
    missing = [
        " ".join(word for word in row[: row.index("not measured")] if word not in ("", "yes"))
        for row in table.rows
        if "not measured" in row
    ]
    notes = [f"Not measured: {', '.join(missing)}"] if missing else []
    return dataclasses.replace(table, header=tuple(header), rows=lines, notes=notes)


def main_names(tables: Tables) -> list[str]:
    """The scenes of the finding."""
    groups = tables.groups()
    return groups.get(MAIN, next(iter(groups.values())))


def size_of(tables: Tables) -> str:
    """The size of the pictures that the captures were judged in."""
    abouts = [tables.scenes[name] for name in main_names(tables)]
    side = max(max(about["width"], about["height"]) for about in abouts)
    reduced = any("photos reduced" in about["differs"] for about in abouts)
    return f"{side} pixels" if reduced else f"full size, {side} pixels"


def findings(all_tables: Sequence[Tables]) -> str:
    """A paragraph on the claims of the paper and one on our rows, for each file. A claim that an
    earlier file decided is not repeated; one that none has measured is named at the end."""
    parts = []
    left = {"paper": list(CLAIMS), "ours": list(OURS)}
    for tables in all_tables:
        names = main_names(tables)
        heads = {"paper": f"Finding ({size_of(tables)}).", "ours": "Merging and compact."}
        for kind, head in heads.items():
            last = tables is all_tables[-1]
            measured = {
                outcome.claim: bool(outcome.differences)
                for outcome in outcomes(left[kind], tables.cells, names)
            }
            shown = [claim for claim in left[kind] if measured[claim] or last]
            left[kind] = [claim for claim in left[kind] if not measured[claim]]
            if shown:
                parts.append(
                    wrapped(f"**{head}** {escaped(paragraph(shown, tables.cells, names))}")
                )
    return "\n\n".join(parts)


def repeated(tables: Tables) -> list[Row]:
    """A cell of one scene for a row of each table: Table 1 has the first, Tables 1 and 2 the
    second, Tables 3 and 4 the third."""
    found = []
    first = sorted(main_names(tables), key=lambda name: name != EXAMPLE)
    for way in (WAYS.pointsplat.protocols[0], WAYS.merge, WAYS.paper):
        keys = (cell_key(name, way, PROTOCOL.ablation_share) for name in first)
        found += [tables.cells[key] for key in keys if key in tables.cells][:1]
    return found


def commands(cells: list[Row]) -> str:
    """The commands of cells, in short lines."""
    lines = (textwrap.wrap(cell["point"]["command"], 114, break_on_hyphens=False) for cell in cells)
    return "\n".join(" \\\n    ".join(words) for words in lines)


def figures_of(cells: list[Row]) -> str:
    """A table of what these cells were measured to be."""
    lines = []
    for cell in cells:
        point = cell["point"]
        found = point["against_photos"] or point["against_dense"]
        shown = [write(found.get(name)) for name, write in WRITTEN.items()]
        lines.append([escaped(point["key"]), f"{point['gaussians']:,}", *shown])
    return markdown(["cell", "Gaussians", *HEADS.values()], lines)


def not_measured(tables: Tables) -> str:
    """The commands that fill rows that were not measured; empty if all were."""
    names = main_names(tables)
    cells = WAYS.cells(PROTOCOL.shares)
    if all(cell_key(name, way, share) in tables.cells for way, share in cells for name in names):
        return ""
    return (
        "Rows that are not measured are filled by these commands: networks on other scenes, "
        "networks on the photos of these, then all cells.\n\n"
        "```bash\n"
        "python -m lab.tables.networks other_outputs -o networks\n"
        "python -m lab.tables.networks outputs -o own_networks --own\n"
        "python -m lab.tables outputs -o tables --refiners shipped networks own_networks\n"
        "```"
    )


def curves(tables: Tables) -> str:
    """The figure of curves, and what their last halves gain; empty without curves."""
    gains = []
    names = main_names(tables)
    for way in TUNED:
        curve = mean_curve(tables.cells, names, way, PROTOCOL.ablation_share)
        if curve:
            steps = f"{curve[-2][0]:,} to {curve[-1][0]:,}"
            gains.append(f"{way.label} {last_gain(curve):+.2f} dB from step {steps}")
    if not gains:
        return ""
    return (
        f"![PSNR over steps of fine-tuning]({CURVES})\n\n*PSNR over the steps of fine-tuning, means "
        f"over the captures. At 10 %, the last half of the steps still gains: {'; '.join(gains)}.*"
    )


def times(all_tables: Sequence[Tables]) -> str:
    """The table of seconds that the cells of each way took, at the smallest share: made, and
    judged; means over scenes of the first file that has them, and its size."""
    seconds = number(1)
    lines = []
    for way, share in WAYS.cells(PROTOCOL.shares):
        for tables in all_tables if share in (1.0, PROTOCOL.ablation_share) else ():
            keys = (cell_key(name, way, share) for name in main_names(tables))
            points = [tables.cells[key]["point"] for key in keys if key in tables.cells]
            if points:
                judged = [p["judged"] for p in points if "judged" in p]
                made = seconds(fmean(p["seconds"] for p in points))
                in_size = size_of(tables)
                lines.append([_name(way), made, seconds(fmean(judged)) if judged else "-", in_size])
                break
    return markdown(["row, 10 %", "s to make", "s to judge", "in"], lines)


def _name(way: Way) -> str:
    weight = "" if way.opacity_weight is None else f", lambda {way.opacity_weight:g}"
    return escaped(f"{way.label}{weight}")


def page(all_tables: Sequence[Tables], files: Sequence[str], record: Path) -> str:
    """The page of all tables and their files; that of encoders and the row of Replica from files in
    a folder."""
    first = all_tables[0]
    abouts = [
        tables.scenes[name]
        for tables in all_tables
        for names in tables.groups().values()
        for name in names
    ]
    heads = ["scene", "judged in", "size", "differs from the paper in"]
    scenes = [
        [
            about["name"],
            f"{about['views']} {about['origin']}",
            f"{about['width']} x {about['height']}",
            about["differs"],
        ]
        for about in abouts
    ]
    examples = repeated(first)
    text = PAGE.format(
        count=len(main_names(first)),
        findings=findings(all_tables),
        files=" and ".join(f"[{name}]({name})" for name in files),
        commands=commands(examples),
        examples=figures_of(examples),
        scenes=markdown(heads, [list(map(escaped, line)) for line in scenes]),
        machines="\n  and ".join(sorted({about["machine"] for about in abouts})),
    )
    shown = []
    for tables in all_tables:
        for group, names in tables.groups().items():
            short = map(shortened, Layout(tables, group, names, ()).tables())
            shown += [f"## Tables: {escaped(group)}, {size_of(tables)}"]
            shown += [markdown_table(table) for table in short if len(table.rows) > 1]
    figure = (
        f"![Opacity and volume]({FIGURE})\n\n*Figure 4: opacity and volume of the Gaussians kept.*"
    )
    alike = encoders.section(json.loads((record / ENCODERS_FILE).read_text("utf-8"))["rows"])
    replica = record / REPLICA_FILE
    of_replica = section(json.loads(replica.read_text("utf-8"))) if replica.is_file() else ""
    cited = SETTINGS.format(table=markdown(["setting", "value", "source"], sources.lines()))
    parts = (
        text,
        *shown,
        not_measured(first),
        next((text for text in map(curves, all_tables) if text), ""),
        figure,
        of_replica,
        alike,
        cited,
    )
    return "\n\n".join(part.strip() for part in parts if part.strip()) + "\n"


def main(files: tyro.conf.Positional[tuple[Path, ...]], record: Path = FOLDER) -> None:
    """Write the record of the paper's tables.

    Args:
        files: tables.json of ``python -m lab.tables``, of the same captures at several sizes, the
            most trustworthy first.
        record: folder for results.md and its figures.
    """
    if not files:
        raise PointSplatError("no file is named; expected docs/record/results.json")
    all_tables = [read(file) for file in files]
    with replacing(record / "results.md") as part:
        part.write_text(page(all_tables, [file.name for file in files], record), "utf-8")
    complete = max(all_tables, key=lambda tables: len(tables.cells))
    plot_figure(complete.cells, complete.groups(), record / FIGURE)
    drawn = next((tables for tables in all_tables if curves(tables)), None)
    if drawn is not None:
        plot_curves(drawn.cells, main_names(drawn), record / CURVES)
    guide = ROOT / "docs" / "tables.md"
    text = put_between(guide.read_text("utf-8"), times(all_tables), guide, TIMES)
    with replacing(guide) as part:
        part.write_text(text, "utf-8")
    print(record / "results.md")


if __name__ == "__main__":
    start(main)
