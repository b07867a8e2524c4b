"""Registration with nerfstudio that cannot break nerfstudio's own commands, and errors in one line there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

from pointsplat_ns.errors import PointSplatError


def load_specification(name: str, build: Callable[[], Any]) -> Any:
    """What ``build`` returns for nerfstudio's registry, or one line that says why a method or dataparser could not be
    loaded.

    nerfstudio does not guard the loading of entry points: one failing import would end every ``ns-*`` command. It does
    skip whatever is not a specification, and prints it in a warning.
    """
    try:
        return build()
    except Exception as error:  # any error here would end every ns-* command
        return f"{name} of pointsplat-ns, which failed to load ({type(error).__name__}: {error})"


class _OneLineHook:
    """Prints a :class:`PointSplatError` in one line; passes any other exception on to the previous hook."""

    def __init__(self, before: Callable[..., object]):
        self._before = before

    def __call__(self, kind: type[BaseException], error: BaseException | None, traceback: TracebackType | None) -> None:
        if isinstance(error, PointSplatError):
            print(f"error: {error}", file=sys.stderr)
        else:
            self._before(kind, error, traceback)


def errors_in_one_line() -> None:
    """Print an uncaught :class:`PointSplatError` in one line, without its traceback. The exit status is 1.

    nerfstudio's commands catch nothing, so a missing photo would print a page of traceback. Calling this again changes
    nothing.
    """
    if not isinstance(sys.excepthook, _OneLineHook):
        sys.excepthook = _OneLineHook(sys.excepthook)
