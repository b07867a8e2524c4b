"""Which version of the package is running."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path


@functools.cache
def source_commit() -> str:
    """The git commit of the package's source, 12 digits, with ``+`` where the package was changed since; empty if it
    runs from no checkout, as when installed.

    Example:
        >>> source_commit() == "" or len(source_commit().rstrip("+")) == 12
        True
    """
    # Whose checkout it is matters: an installed package may lie within somebody else's.
    if _git("ls-files", "--error-unmatch", "__init__.py") is None:
        return ""
    commit, changes = _git("rev-parse", "HEAD"), _git("status", "--porcelain", "--", ".")
    if not commit or changes is None:
        return ""
    return commit.strip()[:12] + ("+" if changes.strip() else "")


def _git(*words: str) -> str | None:
    """Output of a git command in the package's folder; None if it fails or is not there."""
    try:
        command = ["git", "-C", str(Path(__file__).parents[1]), *words]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20.0)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
