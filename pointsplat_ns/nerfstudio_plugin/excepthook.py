"""Errors of this package in one line, also in nerfstudio's commands."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType

from pointsplat_ns.errors import PointSplatError


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
