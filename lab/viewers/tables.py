"""The tables "who opens what" of the guide, from measured rows."""

from __future__ import annotations

from typing import Any

from lab.common.printing import markdown
from lab.viewers.files import FOREIGN, KINDS
from lab.viewers.programs import PROGRAMS

MARKER = "viewers"
"""Name of the markers around the tables in the page."""

NOT_READ = "-"
NOT_SAME = "not the same"


def tables(content: dict[str, Any]) -> str:
    """Both tables: our files in other programs, and files of other programs here.

    Args:
        content: what ``python -m lab.viewers --json`` writes.
    """
    ours = {(row["file"], row["program"]): row for row in content["ours"]}
    versions = {row["program"]: row["version"] for row in content["ours"]}
    programs = [program for program in PROGRAMS if program.name in versions]
    heads = ["File", *(f"{program.name} {versions[program.name]}" for program in programs)]
    rows = [
        [kind.name, *(_cell(ours.get((kind.key, program.name))) for program in programs)]
        for kind in KINDS
    ]
    ups = [
        f"`{program.up}`" if program.page and program.world == "y" else NOT_READ
        for program in programs
    ]
    theirs = {(row["file"], row["program"]): row for row in content["theirs"]}
    read = [
        [
            foreign.name,
            f"{foreign.program} {theirs[foreign.key, foreign.program]['version']}",
            _cell(theirs[foreign.key, foreign.program]),
        ]
        for foreign in FOREIGN
    ]
    first = markdown(heads, [*rows, ["axis to have up", *ups]])
    return f"{first}\n\n{markdown(['File', 'Written by', 'Read here'], read)}"


def _cell(row: dict[str, Any] | None) -> str:
    if row is None:
        return NOT_READ
    return f"{row['psnr']:.0f} dB" if row["same"] else NOT_SAME
