"""Registration with nerfstudio that cannot break nerfstudio's own commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


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
