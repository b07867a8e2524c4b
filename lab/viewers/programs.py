"""The programs that open files, what each opens, and how its picture compares with ours."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

import pointsplat_ns as ps
from lab.viewers.browser import NotOpened, Viewers
from lab.viewers.files import (
    KIND,
    PLACE,
    Files,
    Foreign,
    Kind,
    convert_with_splat_transform,
    read_quietly,
)
from lab.viewers.packages import SPLAT_TRANSFORM, version_of
from lab.viewers.subject import CAMERAS, SAME, compare, render_from

Row = dict[str, Any]


@dataclass(frozen=True)
class Program:
    """A program that opens files of scenes."""

    name: str
    package: str
    opens: tuple[str, ...]
    """Keys of the kinds of files that it opens."""
    page: str = ""
    """Its page; empty for splat-transform, of which this package draws the PLY."""
    up: str = "y"
    """The axis that is up in a file for it, if the file does not declare one."""
    world: str = "y"
    """The axis that is up in its world."""

    @property
    def version(self) -> str:
        return version_of(self.package)

    def up_in(self, kind: Kind) -> str:
        """The axis that is up in its file of a kind."""
        return "z" if kind.declares_up else self.up


PROGRAMS = (
    Program(
        "SuperSplat viewer",
        "@playcanvas/supersplat-viewer",
        ("ply", "sog", "stream"),
        page="supersplat",
        up="-y",
    ),
    Program(
        "PlayCanvas",
        "playcanvas",
        ("ply", "spz4", "sog", "stream", "glb", "gltf"),
        page="playcanvas",
    ),
    Program(
        "three.js",
        "three",
        ("ply", "spz4", "spz3", "spz2", "splat", "glb", "gltf"),
        page="three",
    ),
    Program(
        "Spark",
        "@sparkjsdev/spark",
        ("ply", "spz3", "spz2", "sog", "splat", "rad"),
        page="spark",
    ),
    Program("CesiumJS", "cesium", ("spzglb", "tiles", "placed"), page="cesium", world="z"),
    Program(
        "splat-transform",
        SPLAT_TRANSFORM,
        ("ply", "spz4", "spz3", "spz2", "sog", "stream", "splat"),
    ),
)
PROGRAM = {program.name: program for program in PROGRAMS}


def opened(
    program: Program, kind: Kind, files: Files, viewers: Viewers | None, keep: Path | None = None
) -> Row:
    """Let a program open a file of ours, and compare its picture with that of this package.

    Args:
        program, kind: what opens what.
        files: where files are.
        viewers: the browser; None does for splat-transform.
        keep: folder for its picture.

    Returns:
        The row: ``same`` says whether the picture is upright and the same within :data:`SAME`;
        ``reason`` why there is none, in the program's words.
    """
    up = program.up_in(kind)
    row: Row = {"file": kind.key, "program": program.name, "version": program.version, "up": up}
    camera = CAMERAS[program.world]
    path = files.write(kind, up)
    try:
        if program.page:
            assert viewers is not None, "a browser is needed"
            told = camera.as_json() | ({"place": PLACE} if kind.key == "placed" else {})
            where = path.relative_to(files.folder).as_posix()
            picture = viewers.picture(program.page, where, told)
        else:
            copy = path.with_name(f"{path.name}.by_{program.name}.ply")
            convert_with_splat_transform(path, copy)
            picture = render_from(read_quietly(copy), camera)
    except NotOpened as error:
        return row | {"same": False, "reason": str(error)}
    except subprocess.CalledProcessError as error:
        return row | {"same": False, "reason": " ".join(error.stderr.split())}
    if keep is not None:
        save_picture(picture, keep / f"{program.name} {kind.key}.png".replace(" ", "_"))
    return row | _compared(picture, files.read(kind, up), program.world, up)


def read(foreign: Foreign, files: Files, viewers: Viewers | None) -> Row:
    """Let another program write a file of a scene, and compare this package's picture of the file
    with that of the PLY which the program makes of it again; or of the scene, if it makes none.
    Rows are those of :func:`opened`."""
    program = PROGRAM[foreign.program]
    row: Row = {"file": foreign.key, "program": program.name, "version": program.version}
    source = files.write(KIND["ply"], "-y")
    target = files.folder / "theirs" / foreign.file
    target.parent.mkdir(parents=True, exist_ok=True)
    back = target.with_name(f"{target.name}.back.ply")
    try:
        if foreign.page:
            assert viewers is not None, "a browser is needed"
            where = source.relative_to(files.folder).as_posix()
            target.write_bytes(viewers.written(foreign.page, where))
        else:
            convert_with_splat_transform(source, target, *foreign.options)
        if foreign.read_back:
            convert_with_splat_transform(target, back)
    except NotOpened as error:
        return row | {"same": False, "reason": str(error)}
    except subprocess.CalledProcessError as error:
        return row | {"same": False, "reason": " ".join(error.stderr.split())}
    picture = render_from(read_quietly(target), CAMERAS["y"])
    scene = read_quietly(back if foreign.read_back else source)
    return row | _compared(picture, scene, "y", foreign.up)


def _compared(picture: Tensor, scene: ps.Gaussians, world: str, up: str) -> Row:
    verdict = compare(picture, scene, CAMERAS[world])
    shown = verdict.axes["xyz".index(world)]
    return {
        "same": shown == up and verdict.psnr >= SAME,
        "psnr": round(verdict.psnr, 2),
        "axes": " ".join(verdict.axes),
        "next_psnr": round(verdict.next_psnr, 2),
    }


def save_picture(picture: Tensor, path: Path) -> None:
    """Write a picture (H, W, 3) in [0, 1]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * picture).round().byte().numpy()).save(path)
