"""Reads nerfstudio's ``config.yml`` without executing it.

nerfstudio saves its configuration as YAML with Python objects. The usual loader imports and calls
whatever the file names. Here a tag such as ``!!python/object:pkg.Class`` becomes a :class:`Tagged`
value, paths become :class:`pathlib.Path` and tuples become tuples; no code is imported or called.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import yaml

from pointsplat_ns.errors import SceneError
from pointsplat_ns.system.files import one_line, read_text, require_file


@dataclass(frozen=True)
class Tagged:
    """A Python object in the file; it is not constructed."""

    tag: str
    """Dotted name of its class or function."""
    value: Any
    """The plain fields or arguments; None for a bare name."""

    @property
    def fields(self) -> dict[str, Any]:
        """The value if it is a dictionary of fields, else an empty dictionary."""
        return self.value if isinstance(self.value, dict) else {}


class _Loader(yaml.SafeLoader):
    """``SafeLoader`` that accepts YAML's Python tags as :class:`Tagged` values."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse merge keys: nested ones grow exponentially, and nerfstudio writes none."""
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise yaml.constructor.ConstructorError(
                None, None, "merge keys are not supported", node.start_mark
            )


def read_config(path: Path | str) -> Tagged:
    """Read a ``config.yml``.

    Aliases share one value, so they cannot exhaust memory.

    Returns:
        The configuration object at the root of the file.

    Raises:
        SceneError: if the file is not YAML, is too large or too deeply nested, or has no Python
            object at its root.
    """
    path = require_file(path, "nerfstudio's config.yml")
    # nerfstudio writes about 10 kB
    size = path.stat().st_size
    most = 1 << 18
    if size > most:
        raise SceneError(
            f"{path}: {size} bytes; expected a nerfstudio config.yml of at most {most}"
        )
    try:
        loader = _Loader(read_text(path))
        try:
            node = loader.get_single_node()
            if node is not None:
                _count(node, {})
            root = loader.construct_document(node) if node is not None else None
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        line = f" at line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise SceneError(
            f"{path}: not a nerfstudio config.yml ({error.problem or 'not YAML'}{line})"
        ) from error
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError, OSError) as error:
        raise SceneError(f"{path}: not a nerfstudio config.yml ({one_line(error, 100)})") from error
    if not isinstance(root, Tagged) or not root.fields:
        raise SceneError(
            f"{path}: not a nerfstudio config.yml; expected a saved trainer configuration"
        )
    return root


def _count(node: yaml.Node, known: dict[int, int], most: int = 1 << 16) -> int:
    """Number of values below a node, with the values of an alias counted at every use; a ValueError
    if there are more than ``most``, or the node contains itself. The text of a value, and its hash
    as a key, take time in proportion to this number. nerfstudio's file has some hundreds.

    ``known`` maps node identities to numbers; 0 marks nodes that are being counted.
    """
    if id(node) in known:
        if not known[id(node)]:
            raise ValueError("a recursive value: it contains itself")
        return known[id(node)]
    known[id(node)] = 0
    parts = node.value if isinstance(node, yaml.CollectionNode) else ()
    if isinstance(node, yaml.MappingNode):
        parts = [part for pair in node.value for part in pair]
    count = 1 + sum(_count(part, known) for part in parts)
    if count > most:
        raise ValueError(f"more than {most} values")
    known[id(node)] = count
    return count


def _python(loader: _Loader, suffix: str, node: yaml.Node) -> Any:
    """The inert value of a tag ``!!python/<suffix>``."""
    kind, _, name = suffix.partition(":")
    value = _plain(loader, node)
    if kind == "tuple" and isinstance(value, list):
        return tuple(value)
    of_text = isinstance(value, list) and all(isinstance(part, str) for part in value)
    if kind.startswith("object/") and name.startswith("pathlib") and of_text:
        parts = [PureWindowsPath(part).as_posix() for part in value] if "Windows" in name else value
        return Path(*parts)
    return Tagged(name or kind, None if kind == "name" else value)


def _plain(loader: _Loader, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_object(
        yaml.ScalarNode(loader.resolve(yaml.ScalarNode, node.value, (True, False)), node.value)
    )


_Loader.add_multi_constructor("tag:yaml.org,2002:python/", _python)
_Loader.add_multi_constructor(
    "!", lambda loader, suffix, node: Tagged(f"!{suffix}", _plain(loader, node))
)
