"""How this package enters nerfstudio without being able to break it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def load_specification(name: str, build: Callable[[], Any]) -> Any:
    """A specification for nerfstudio's registry, or one line saying why there is none.

    nerfstudio loads entry points unguarded, so that one failing import would end every ``ns-*`` command of the
    user. What is not a specification it names in a warning and skips.

    Args:
        name: of the method or dataparser, as the user types it.
        build: imports what the specification needs and makes it.
    """
    try:
        return build()
    except Exception as error:  # any failure here would otherwise be every command's
        return f"{name} of pointsplat-ns, which failed to load ({type(error).__name__}: {error})"
