"""Lines in the log of nerfstudio's commands."""

from __future__ import annotations

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from pointsplat_ns.errors import printable


def log(text: str) -> None:
    """Log a line on nerfstudio's console. What a name of a file put into it neither steers the
    terminal nor is markup."""
    CONSOLE.log(escape(printable(text)), _stack_offset=2)
