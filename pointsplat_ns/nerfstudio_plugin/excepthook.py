"""What the plugin changes in the process that loads it; each change is narrow and safe to make twice."""

from __future__ import annotations

import sys

from pointsplat_ns.errors import PointSplatError


def errors_in_one_line() -> None:
    """Let an uncaught :class:`PointSplatError` end the program with its one line and exit status 1.

    nerfstudio's commands catch nothing, so that a missing photo would print a page of traceback. Every other
    exception goes to the hook that was there before.
    """
    before = sys.excepthook
    if getattr(before, "for_pointsplat", False):
        return

    def hook(kind, error, traceback) -> None:
        if isinstance(error, PointSplatError):
            print(f"error: {error}", file=sys.stderr)
        else:
            before(kind, error, traceback)

    hook.for_pointsplat = True  # type: ignore[attr-defined]
    sys.excepthook = hook
