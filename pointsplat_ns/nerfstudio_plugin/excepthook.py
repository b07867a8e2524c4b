"""What the plugin changes in the process that loads it; each change is narrow and safe to make twice."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import TracebackType

from pointsplat_ns.errors import PointSplatError


class _OneLineHook:
    """Prints a :class:`PointSplatError` in one line; any other exception goes to the hook that was there before."""

    def __init__(self, before: Callable[..., object]):
        self._before = before

    def __call__(self, kind: type[BaseException], error: BaseException | None, traceback: TracebackType | None) -> None:
        if isinstance(error, PointSplatError):
            print(f"error: {error}", file=sys.stderr)
        else:
            self._before(kind, error, traceback)


def errors_in_one_line() -> None:
    """Let an uncaught :class:`PointSplatError` end the program with its one line and exit status 1.

    nerfstudio's commands catch nothing, so that a missing photo would print a page of traceback.
    """
    if not isinstance(sys.excepthook, _OneLineHook):
        sys.excepthook = _OneLineHook(sys.excepthook)
