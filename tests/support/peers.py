"""A program that stands for splat-transform."""

import sys
from pathlib import Path

PEER = """#!{python}
import re, sys
if "--version" in sys.argv:
    print({says!r})
    sys.exit()
overwrite, device, cpu, source, option, count, target = sys.argv[1:]
if option == {fails!r}:
    sys.exit("out of luck")
assert [overwrite, device, cpu] == ["-w", "-g", "cpu"] and option in {options}, sys.argv
count = int(count)
header, found, rows = open(source, "rb").read().partition(b"end_header\\n")
size = 4 * header.count(b"property float")
rows = rows[: count * size] if option == "--decimate" else rows[-count * size :]
header = re.sub(rb"element vertex \\d+", b"element vertex %d" % count, header)
open(target, "wb").write(header + found + rows)
"""
"""Stands for splat-transform, a Node package: takes its options, and keeps the first or the last
Gaussians."""


def peer(folder: Path, version: str, says: str | None = None, fails: str = "") -> str:
    """The path of such a program, written into a folder; from version 3 on it has two modes."""
    says = f"splat-transform v{version} (0123abc)" if says is None else says
    options = ("--decimate", "--decimate-adaptive")[: 1 + (version >= "3")]
    path = folder / f"peer-{version}"
    path.write_text(PEER.format(python=sys.executable, says=says, fails=fails, options=options))
    path.chmod(0o755)
    return str(path)
