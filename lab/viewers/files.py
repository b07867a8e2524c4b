"""Files of the scene: ours, as the guide says that they are written for each program, and those of
other programs."""

from __future__ import annotations

import contextlib
import io
import subprocess
import warnings
from dataclasses import dataclass
from pathlib import Path

import pointsplat_ns as ps
from lab.viewers.packages import splat_transform
from lab.viewers.subject import subject
from pointsplat_ns.cli import main
from pointsplat_ns.errors import PointSplatError

PLACE = (48.8584, 2.2945, 35.0)
"""Latitude and longitude in degrees, and height in metres, of the tiles on the globe."""


@dataclass(frozen=True)
class Kind:
    """A kind of file that this package writes."""

    key: str
    name: str
    """As the guide names it."""
    file: str
    """Its path in the folder of all files with the same axis up."""
    command: str = "convert"
    options: tuple[str, ...] = ()
    declares_up: bool = False
    """Whether readers turn its up axis to theirs."""
    same_as: str = ""
    """Key of a file that this package reads in the frame in which programs draw this one."""


KINDS = (
    Kind("ply", "`.ply`", "room.ply"),
    Kind("spz4", "`.spz`, version 4", "room.spz"),
    Kind("spz3", "`.spz`, version 3", "room_3.spz", options=("--spz-version", "3")),
    Kind("spz2", "`.spz`, version 2", "room_2.spz", options=("--spz-version", "2")),
    Kind("sog", "`.sog`", "room.sog"),
    Kind("stream", "streamed SOG", "stream/lod-meta.json", "lod", ("--stream",)),
    Kind("splat", "`.splat`", "room.splat"),
    Kind("glb", "`.glb`", "room.glb", declares_up=True),
    Kind("gltf", "`.gltf`", "room.gltf", declares_up=True),
    Kind("spzglb", "`.spz.glb`", "room.spz.glb", declares_up=True),
    Kind("rad", "`.rad`", "room.rad", "lod"),
    Kind("tiles", "3D Tiles", "tiles/tileset.json", "lod", ("--tiles",), declares_up=True),
    Kind(
        "placed",
        "3D Tiles on the globe",
        "placed/tileset.json",
        "lod",
        ("--tiles", f"--at={','.join(map(str, PLACE))}"),
        declares_up=True,
        same_as="tiles",
    ),
)
KIND = {kind.key: kind for kind in KINDS}


class Files:
    """Our files, each written when it is first asked for.

    Args:
        folder: where they lie, by the axis that is up.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.source = folder / "source.ply"
        if not self.source.is_file():
            ps.save(subject(), self.source)

    def write(self, kind: Kind, up: str) -> Path:
        """A file with an axis up, written by a command that the guide shows."""
        path = self.folder / up / kind.file
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            if kind.command == "convert":
                words = ["convert", str(self.source), str(path), f"--up={up}"]
            else:
                source = self.source if up == "z" else self.write(KIND["ply"], up)
                target = path.parent if path.suffix == ".json" else path
                words = ["lod", str(source), "-o", str(target)]
            words += kind.options
            run_quietly(words)
        return path

    def read(self, kind: Kind, up: str) -> ps.Gaussians:
        """A file as this package reads it, in the frame in which programs draw it."""
        path = self.write(kind, up)
        if kind.same_as:
            path = self.write(KIND[kind.same_as], up)
        return read_quietly(path)


def run_quietly(words: list[str]) -> None:
    """Run a command of this package without its output. Raises PointSplatError with what it said if
    it fails."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            main(words)
    except SystemExit as end:
        raise PointSplatError(f"pointsplat {' '.join(words)}: {said.getvalue()}") from end


def read_quietly(path: Path) -> ps.Gaussians:
    """Read a scene without the notes on what its file lacks."""
    with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        return ps.load(path)


def convert_with_splat_transform(source: Path, target: Path, *options: str) -> None:
    """Let splat-transform read a file and write another. Raises CalledProcessError, with its words
    in ``stderr``, if it fails."""
    target.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        [*splat_transform(), "-q", "-w", "-g", "cpu", str(source), *options, str(target)],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )


@dataclass(frozen=True)
class Foreign:
    """A file of another program, which this package reads."""

    key: str
    name: str
    """As the guide names it."""
    program: str
    file: str
    options: tuple[str, ...] = ()
    """Of splat-transform."""
    page: str = ""
    """The page that writes it; empty for splat-transform."""
    up: str = "y"
    """The axis of the scene that is up, if y is up in what is read: another one than y only if the
    file declares its axes, and the scene had another one up."""
    read_back: bool = True
    """Whether splat-transform wrote it and reads it, too."""


_FEW = ("-i", "1")
"""Iterations of the palette of SH: one does, as a file is compared with what it holds."""

FOREIGN = (
    Foreign("ply", "`.ply`", "splat-transform", "theirs.ply"),
    Foreign("compressed", "`.compressed.ply`", "splat-transform", "theirs.compressed.ply"),
    Foreign("spz4", "`.spz`, version 4", "splat-transform", "theirs.spz"),
    Foreign("spz3", "`.spz`, version 3", "splat-transform", "theirs_3.spz", ("--spz-version", "3")),
    Foreign("sog", "`.sog`", "splat-transform", "theirs.sog", _FEW),
    Foreign("folder", "SOG, a folder", "splat-transform", "theirs_sog/meta.json", _FEW),
    Foreign("stream", "streamed SOG", "splat-transform", "theirs_stream/lod-meta.json", _FEW),
    Foreign("glb", "`.glb`", "splat-transform", "theirs.glb", up="-y", read_back=False),
    Foreign(
        "spz2", "`.spz`, version 2", "Spark", "spark.spz", page="spark_writes", read_back=False
    ),
)
"""What other programs write and this package reads."""
