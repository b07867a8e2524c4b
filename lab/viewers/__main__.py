"""Opens our files in the programs that draw them, and theirs here:

python -m lab.viewers --json docs/record/viewers.json --pictures outputs/viewers
python -m lab.viewers --write docs/record/viewers.json docs/formats.md
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import tyro

from lab.common.printing import console, put_between, start, table
from lab.common.results import write_json
from lab.viewers.browser import viewers
from lab.viewers.files import FOREIGN, KIND, Files
from lab.viewers.programs import PROGRAMS, opened, read
from lab.viewers.subject import GAUSSIANS, SAME, SIZE
from lab.viewers.tables import MARKER, tables
from pointsplat_ns.system.files import replacing


def measure(
    json: Path | None = None,
    files: Path | None = None,
    pictures: Path | None = None,
    programs: tuple[str, ...] = (),
    kinds: tuple[str, ...] = (),
    write: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="JSON PAGE")] = None,
) -> None:
    """Open every file in every program, and every file of another program here. Needs Node with
    npm, and installs what ``lab/viewers/package.json`` names. Four seconds a file, on a busy
    machine 20.

    Args:
        json: file for the rows.
        files: folder for the files, to look at; by default a temporary one.
        pictures: folder for the pictures.
        programs: names of the programs; by default all.
        kinds: keys of the kinds of files, such as spz4; by default all.
        write: JSON of an earlier call, and the page to write its tables into; nothing is opened.
    """
    if write is not None:
        write_tables(*write)
        return
    ours = []
    theirs = []
    shown = console()
    with ExitStack() as stack:
        made = Files(files or Path(stack.enter_context(tempfile.TemporaryDirectory())))
        opener = stack.enter_context(viewers(made.folder))
        for program in PROGRAMS:
            if not programs or program.name in programs:
                for key in program.opens:
                    if not kinds or key in kinds:
                        ours.append(opened(program, KIND[key], made, opener, pictures))
                        shown.print(ours[-1])
        for foreign in FOREIGN:
            if (not programs or foreign.program in programs) and not kinds:
                theirs.append(read(foreign, made, opener))
                shown.print(theirs[-1])
    settings = {"gaussians": GAUSSIANS, "size": SIZE, "same": SAME}
    write_json(json, {"settings": settings, "ours": ours, "theirs": theirs})
    heads = ("file", "program", "same", "dB", "next", "axes", "reason")
    keys = ("file", "program", "same", "psnr", "next_psnr", "axes", "reason")
    rows = [[row.get(key, "") for key in keys] for row in (*ours, *theirs)]
    shown.print(table("Who opens what", heads, rows, left=("program", "axes", "reason")))


def write_tables(rows: Path, page: Path) -> None:
    """Write the tables of measured rows between the markers of a page."""
    text = page.read_text("utf-8")
    content = json.loads(rows.read_text("utf-8"))
    with replacing(page) as part:
        part.write_text(put_between(text, tables(content), page, MARKER), "utf-8")


if __name__ == "__main__":
    start(measure)
