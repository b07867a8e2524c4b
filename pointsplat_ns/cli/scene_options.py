"""Arguments and output paths of several commands, and rules for tyro to parse counts and sizes."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import docstring_parser
import tyro
from tyro import MISSING
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
"""Options of a dataclass, without its name as a prefix."""


def _paragraphs(documented: Any) -> dict[str, str]:
    """Description of each parameter or field in a docstring, as one paragraph."""
    return {
        part.arg_name: " ".join(part.description.split())
        for part in docstring_parser.parse_from_object(documented).params
        if part.description is not None
    }


def _field_docstrings(kind: type) -> dict[str, str]:
    """Docstring of each field of a dataclass and its bases, as one paragraph."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        found |= _paragraphs(base)
    return found


_COMMANDS = __name__.rpartition(".")[0]
"""The package of the commands."""

_VIEWS = _field_docstrings(ViewOptions)

# For commands with some of the ViewOptions.
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
Cluster = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="ADDRESS",
        help="for a folder: dask cluster whose workers share the work, such as tcp://host:8786, or "
        "a scheduler file; by default none.",
    ),
]
Verbose = Annotated[
    bool, tyro.conf.arg(help="print details of the result and of choices for the scene.")
]
Json = Annotated[
    bool,
    tyro.conf.arg(
        name="json", help="print the result as JSON and nothing else on standard output."
    ),
]


def output_beside(scene: Path, name: str, suffix: str | None = None) -> Path:
    """The default path of a result, by default in the format of the scene.

    The result of a file is beside it: ``room_pruned.ply`` for ``room.ply``. The result of a run is
    in its folder: ``pruned.ply``; never in the folder of checkpoints, because nerfstudio takes all
    files there for checkpoints. The path is automatic, so a symbolic link there is not followed."""
    from pointsplat_ns.scene.formats import format_like, format_named
    from pointsplat_ns.system.outputs import unnamed

    name = f"{name}{format_like(scene).suffix if suffix is None else suffix}"
    if scene.is_dir():
        return unnamed(scene / name)
    if scene.absolute().parent.name == "nerfstudio_models":
        return unnamed(scene.absolute().parents[1] / name)
    if scene.suffix.lower() in (".yml", ".yaml"):
        return unnamed(scene.with_name(name))
    known = format_named(scene.name)
    ending = known.suffix if known is not None and known.suffix.startswith(".") else scene.suffix
    return unnamed(scene.with_name(f"{scene.name[: len(scene.name) - len(ending)]}_{name}"))


def need_scenes(*paths: Path | None) -> None:
    """Raise a SceneError, before torch is imported, that lists all missing paths."""
    from pointsplat_ns.errors import SceneError

    missing = []
    for path in filter(None, paths):
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            missing.append(str(path))
        except (OSError, ValueError):
            pass  # the reader raises a clearer error
    if missing:
        fault = "no such file" if len(missing) == 1 else "no such files"
        raise SceneError(f"{', '.join(missing)}: {fault}; expected a scene: {ONE_SCENE}")


def need_one_scene(path: Path, instead: str = "compact, convert and info accept one") -> None:
    """Raise a SceneError if the path is a folder of scenes; ``instead`` says what accepts it."""
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.scene.reading import SCENE_KINDS, is_folder_of_scenes

    if is_folder_of_scenes(path):
        raise SceneError(
            f"{path}: a folder without config.yml, so not a run; expected {SCENE_KINDS}; for a "
            f"folder of scenes: {instead}"
        )


def check_outputs(
    scene: Path | None, force: bool, png: Path | None = None, html: Path | None = None
) -> None:
    """Check output files (a scene of any writable format, a picture, a page) before long
    computations. Raises SceneError if a path has the wrong suffix, or as
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
    """Raise a SceneError if ``poses`` is a run or a scene instead of a camera file."""
    if poses is None:
        return
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.scene.camera_files import CAMERA_KINDS, is_camera_file

    if not (str(poses) == NO_POSES or is_camera_file(poses)):
        raise SceneError(
            f"{poses}: a run or a scene; expected {CAMERA_KINDS}; poses of a run's own dataset "
            "need no --poses"
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
    """A context in which tyro parses numbers by
    :func:`~pointsplat_ns.system.quantities.parse_number`, and rejects empty paths (see
    :func:`~pointsplat_ns.pipeline.options.parse_path`)."""
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
    def with_plain_help(info: StructTypeInfo) -> StructConstructorSpec | None:
        """Commands and dataclasses of options, with the help of every option as one paragraph."""
        kind: Any = info.type
        if inspect.isfunction(kind) and kind.__module__.startswith(_COMMANDS):
            defaults = {
                name: MISSING if parameter.default is parameter.empty else parameter.default
                for name, parameter in inspect.signature(kind).parameters.items()
            }
            help_of = _paragraphs(kind)
        elif isinstance(kind, type) and issubclass(kind, (ViewOptions, ReductionOptions)):
            defaults = {field.name: field.default for field in dataclasses.fields(kind)}
            help_of = _field_docstrings(kind)
        else:
            return None
        types = get_type_hints(kind, include_extras=True)
        fields = tuple(
            StructFieldSpec(
                name=name, type=types[name], default=default, helptext=help_of.get(name)
            )
            for name, default in defaults.items()
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
        return (
            own[0] if own else rules.get(kinds[0])
        )  # an optional number follows the rule of the number

    return registry


def _float(text: str) -> float:
    if text.lower().lstrip("+-") in ("nan", "inf"):
        return float(text)  # commands reject it
    return parse_number(text)
