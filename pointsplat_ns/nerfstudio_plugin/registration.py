"""Registration with nerfstudio that cannot break its commands; errors there in one line; warnings
that nobody can help.

:data:`JIT_SCRIPT` is raised before nerfstudio loads any plugin, so nothing here can silence it in a
``ns-*`` command.
"""

from __future__ import annotations

import importlib
import itertools
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.terminal import say

JIT_SCRIPT = "ignore:`torch.jit.script` is deprecated:FutureWarning:torch.jit._script"
"""Value of the environment variable PYTHONWARNINGS that hides a warning: nerfstudio scripts a
function at import."""


def load_specification(name: str, build: Callable[[], Any]) -> Any:
    """What ``build`` returns for nerfstudio's registry, or one line that says why it could not be
    loaded.

    nerfstudio does not guard the loading of entry points: one failing import would end every
    ``ns-*`` command. It does skip whatever is not a specification, and prints it in a warning.
    """
    try:
        return build()
    except Exception as error:  # any error here would end every ns-* command
        return f"{name} of pointsplat-ns, which failed to load ({type(error).__name__}: {error})"


def errors_in_one_line() -> None:
    """Print an uncaught :class:`PointSplatError` or an interruption in one line, without its
    traceback. The exit status is 1, or that of an interrupted program."""
    before = sys.excepthook

    def print_error(
        kind: type[BaseException], error: BaseException, traceback: TracebackType | None
    ) -> None:
        if isinstance(error, PointSplatError):
            say(f"error: {error}", error=True)
        elif isinstance(error, KeyboardInterrupt):
            say("interrupted", error=True)
        else:
            before(kind, error, traceback)
            if hint := _export_hint(sys.argv):
                say(hint, error=True)

    sys.excepthook = print_error


def _export_hint(words: list[str]) -> str:
    """What to do when ``ns-export`` fails, as it does for runs of ``splatfacto`` where there is no
    GPU or no data; empty for other commands."""
    if not words or Path(words[0]).stem != "ns-export":
        return ""
    run = next((b for a, b in itertools.pairwise(words) if a == "--load-config"), "RUN")
    return f"without nerfstudio, a GPU or photos: pointsplat export {run} -o scene.ply"


def quiet_nerfstudio() -> None:
    """Ignore warnings that torch and Python raise for nerfstudio's own modules, from now on in this
    process: a user can do nothing about them."""
    for category in (FutureWarning, UserWarning):
        warnings.filterwarnings("ignore", category=category, module=r"nerfstudio\.")


def import_nerfstudio() -> None:
    """Import the first modules of nerfstudio without the warnings that come with it.

    nerfstudio loads plugins while it is itself only half imported; after this call its modules can
    be imported in any order. Call it before importing any module that needs nerfstudio, in code
    that nerfstudio does not run itself.
    """
    quiet_nerfstudio()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)
        importlib.import_module("nerfstudio.cameras.camera_utils")
