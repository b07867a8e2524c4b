"""Standard streams that take any text: closed ones, ones with few characters, and terminals that obey what they get."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

from pointsplat_ns.errors import printable

_STEERING = re.compile(r"\x1b\[(?:[\d;]*m|\?25[lh]|\d*[AK])|[^\t\n\r\x20-\x7e\xa0-\U0010ffff]+")
"""Colours and the moves of progress bars, which are ours; any other control characters, which are not."""


class _Shown:
    """A text stream that shows control characters, such as those in the name of a file, instead of sending them."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write(_STEERING.sub(lambda m: m[0] if m[0].startswith("\x1b[") else printable(m[0]), text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def any_text_printable() -> Iterator[None]:
    """Let standard output and standard error take any text while the context is open.

    Streams that are closed go nowhere. Characters that an encoding lacks are replaced. Control characters are shown as
    Python writes them, such as ``\\x1b``; only colours and progress bars reach a terminal.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:  # the lowest free number is this one: no file that is written gets it
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    out, err = (stream or open(os.devnull, "w", encoding="utf-8") for stream in before)
    errors = out.errors
    if isinstance(out, io.TextIOWrapper):
        out.reconfigure(errors="replace")
    sys.stdout, sys.stderr = (cast(TextIO, _Shown(stream)) for stream in (out, err))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        if isinstance(out, io.TextIOWrapper):
            out.reconfigure(errors=errors)


def discard_output() -> None:
    """Send standard output nowhere from now on: what a closed pipe or a full disk did not take is not tried again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
