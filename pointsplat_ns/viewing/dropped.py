"""Takes a scene file that is dropped on the viewer's page, as a file of its own name."""

from __future__ import annotations

import shutil
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.formats import FORMATS
from pointsplat_ns.viewing.server import Request

LARGEST = 4_000_000_000
"""Largest file that may be dropped, bytes."""

PIECE = 1 << 20
"""Bytes that are received at once."""

READABLE_NAMES = (*(kind.suffix for kind in FORMATS if kind.read and kind.suffix.startswith(".")), ".ckpt")
"""Ends of the names of files that may be dropped."""


def received(request: Request, folder: Path) -> tuple[Path, str]:
    """Write the body of a request into an empty folder: the file, and its name for people.

    The client's name (``name`` in the options) decides the end of the file's name, which has to be one of
    :data:`READABLE_NAMES`, and is shown to people. It is no path. Raises SceneError if no scene has such a name, the
    file is empty, or there is no room for it, and ValueError if the client sends less than it said.
    """
    given = request.options["name"]
    name = "".join(sign if sign.isprintable() else "?" for sign in given.replace("\\", "/").rpartition("/")[2])[:80]
    suffix = next((suffix for suffix in READABLE_NAMES if given.lower().endswith(suffix)), None)
    if suffix is None:
        raise SceneError(f"{name}: not a scene; expected a file of {', '.join(READABLE_NAMES)}")
    if request.length == 0:
        raise SceneError(f"{name}: an empty file; expected a scene")
    if shutil.disk_usage(folder).free < 1.1 * request.length:
        raise SceneError(f"{name}: {request.length / 1e6:.0f} MB; the disk here has less room")
    path = folder / f"scene{suffix}"
    with path.open("wb") as stream:
        while data := request.body.read(PIECE):
            stream.write(data)
    return path, name
