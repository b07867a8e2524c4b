"""Arguments and output paths that several commands share, and how counts and sizes are read as
people write them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import docstring_parser
import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from pointsplat_ns.pipeline import options
from pointsplat_ns.pipeline.options import NO_POSES, ReductionOptions, ViewOptions
from pointsplat_ns.system.quantities import parse_count, parse_megabytes, parse_number

ONE_SCENE = "a file of any format, a checkpoint, or a run (its folder or config.yml)"

Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(help=ONE_SCENE)]
Scenes = Annotated[
    Path, tyro.conf.Positional, tyro.conf.arg(help=f"{ONE_SCENE}, or a folder of scenes")
]
Output = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
Options = TypeVar("Options")
Flat = Annotated[Options, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="", help="")]
"""Options of a dataclass, without its name before theirs."""


def _field_docstrings(kind: type) -> dict[str, str]:
    """The docstring of each field of a dataclass and its bases, each as one paragraph."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        for part in docstring_parser.parse_from_object(base).params:
            if part.description is not None:
                found[part.arg_name] = " ".join(part.description.split())
    return found


_VIEWS = _field_docstrings(ViewOptions)

# For commands that take some of the ViewOptions.
Poses = Annotated[options.Poses, tyro.conf.arg(help=_VIEWS["poses"])]
Resolution = Annotated[options.Resolution, tyro.conf.arg(help=_VIEWS["resolution"])]
Up = Annotated[str | None, tyro.conf.arg(metavar="AXIS", help=_VIEWS["up"])]
Data = Annotated[Path | None, tyro.conf.arg(help=_VIEWS["data"])]

Force = Annotated[bool, tyro.conf.arg(help="overwrite existing files.")]
Jobs = Annotated[
    int | None,
    tyro.conf.arg(
        help="for a folder: number of processes that share the work and the cores; by default 1."
    ),
]
Verbose = Annotated[bool, tyro.conf.arg(help="print more: what was chosen for the scene.")]
Json = Annotated[
    bool,
    tyro.conf.arg(
        name="json", help="print the result as JSON, and nothing else on standard output."
    ),
]


def output_beside(scene: Path, what: str, suffix: str | None = None) -> Path:
    """The default path of a result, by default in the format of the scene's file. For a file, it is
    beside it: ``room_pruned.ply`` for ``room.ply``. For a run, it is in its folder: ``pruned.ply``;
    never in its checkpoint folder, because nerfstudio takes every file there for a checkpoint.
    Nobody named it: a symbolic link there is not followed."""
    from pointsplat_ns.scene.formats import format_like
    from pointsplat_ns.system.outputs import unnamed

    name = f"{what}{format_like(scene).suffix if suffix is None else suffix}"
    if scene.is_dir():
        return unnamed(scene / name)
    if scene.absolute().parent.name == "nerfstudio_models":
        return unnamed(scene.absolute().parents[1] / name)
    if scene.suffix.lower() in (".yml", ".yaml"):
        return unnamed(scene.with_name(name))
    return unnamed(scene.with_name(f"{scene.stem.removesuffix('.compressed')}_{name}"))


def need_scenes(*paths: Path | None) -> None:
    """Raise a SceneError, before torch is imported, that names all paths at which there is
    nothing."""
    from pointsplat_ns.errors import SceneError

    gone = []
    for path in filter(None, paths):
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            gone.append(str(path))
        except (OSError, ValueError):
            pass  # the reader says more
    if gone:
        what = "no such file" if len(gone) == 1 else "no such files"
        raise SceneError(f"{', '.join(gone)}: {what}; expected a scene: {ONE_SCENE}")


def need_one_scene(path: Path) -> None:
    """Raise a SceneError if the path is a folder of scenes."""
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.scene.reading import SCENE_KINDS, is_folder_of_scenes

    if is_folder_of_scenes(path):
        raise SceneError(
            f"{path}: a folder without config.yml, so no run; expected {SCENE_KINDS}; compact and "
            "info take a folder of scenes"
        )


def check_outputs(
    scene: Path | None, force: bool, png: Path | None = None, html: Path | None = None
) -> None:
    """Check the files that a command is going to write (a scene of any writable format, a picture,
    a page) before its long computations. Raises SceneError if a path has another suffix, or as
    :func:`~pointsplat_ns.system.files.need_writable`."""
    from pointsplat_ns.scene.formats import format_to_write
    from pointsplat_ns.system.files import need_suffix, need_writable

    if scene is not None:
        format_to_write(scene)
    for path, kind in ((png, ".png"), (html, ".html")):
        if path is not None:
            need_suffix(path, kind)
    for path in filter(None, (scene, png, html)):
        need_writable(path, force)


def check_poses(poses: Path | str | None) -> None:
    """Raise a SceneError if a path cannot hold cameras because it is a run or a scene."""
    if poses is None:
        return
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.scene.camera_files import CAMERA_KINDS, is_camera_file

    if not (str(poses) == NO_POSES or is_camera_file(poses)):
        raise SceneError(
            f"{poses}: a run or a scene; expected {CAMERA_KINDS}; the poses of a run's own "
            "dataset need no --poses"
        )


def _spec(metavar: str, parse: Callable[[str], Any]) -> PrimitiveConstructorSpec:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda value: (
            value is None or isinstance(value, (int, float)) and not isinstance(value, bool)
        ),
        str_from_instance=lambda value: [f"{value:g}" if isinstance(value, float) else str(value)],
    )


Megabytes = Annotated[float, _spec("MB", parse_megabytes)]
"""A size, in units of 10^6 bytes: 12, 12MB, 800kB or 1GB."""


def quantities() -> ConstructorRegistry:
    """A context in which tyro reads numbers as
    :func:`~pointsplat_ns.system.quantities.parse_number` does, and refuses empty paths, which would
    be the current folder: those of a script whose variable is not set."""
    registry = ConstructorRegistry()
    rules = {int: _spec("INT", parse_count), float: _spec("FLOAT", _float)}

    path = PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: options.parse_path(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    )

    @registry.struct_rule
    def options_with_plain_help(info: StructTypeInfo) -> StructConstructorSpec | None:
        """Options of a dataclass, with each docstring as one paragraph."""
        kind = info.type
        if not (isinstance(kind, type) and issubclass(kind, (ViewOptions, ReductionOptions))):
            return None
        types = get_type_hints(kind, include_extras=True)
        help_of = _field_docstrings(kind)
        fields = tuple(
            StructFieldSpec(
                name=field.name,
                type=types[field.name],
                default=field.default,
                helptext=help_of.get(field.name, ""),
            )
            for field in dataclasses.fields(kind)
        )
        return StructConstructorSpec(instantiate=kind, fields=fields)

    @registry.primitive_rule
    def number_or_path(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if info.type is Path:
            return path
        kinds = [kind for kind in get_args(info.type) or (info.type,) if kind is not type(None)]
        if len(kinds) != 1:
            return None
        own = [
            item
            for item in getattr(kinds[0], "__metadata__", ())
            if isinstance(item, PrimitiveConstructorSpec)
        ]
        return own[0] if own else rules.get(kinds[0])  # of an optional number as of the number

    return registry


def _float(text: str) -> float:
    return (
        float(text) if text.lower().lstrip("+-") in ("nan", "inf") else parse_number(text)
    )  # commands refuse them
