"""Chooses of many inputs the small ones that together reach every branch that all of them reach."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

from fuzz_readers import Read

HASH = 16
"""Letters of a name that a fuzzer gives; shorter ones are those that people gave."""

Branch = tuple[str, int, int]
"""A file of code, and the lines that a step leads from and to."""


def fewest(read: Read, files: Iterable[Path], packages: Iterable[str], most_bytes: int) -> list[Path]:
    """The smallest inputs that each reach something that smaller ones do not. Those that people named come first.

    Args:
        read: the reader.
        files: its inputs.
        packages: names of the packages in which branches count.
        most_bytes: size of all that are chosen, at most, without those that have names.
    """
    chosen: list[Path] = []
    reached: set[Branch] = set()
    size = 0
    for path in sorted(files, key=lambda path: (len(path.name) >= HASH, path.stat().st_size, path.name)):
        branches = _branches(read, path.read_bytes(), tuple(packages))
        named = len(path.name) < HASH
        if not named and (branches <= reached or size + path.stat().st_size > most_bytes):
            continue
        chosen.append(path)
        reached |= branches
        size += 0 if named else path.stat().st_size
    return chosen


def _branches(read: Read, data: bytes, packages: tuple[str, ...]) -> set[Branch]:
    found: set[Branch] = set()

    def called(frame: FrameType, event: str, argument: Any) -> Any:
        name = frame.f_code.co_filename
        if not any(f"/{package.replace('.', '/')}" in name for package in packages):
            return None
        before = 0

        def stepped(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal before
            found.add((name, before, frame.f_lineno))
            before = frame.f_lineno
            return stepped

        return stepped

    sys.settrace(called)
    try:
        with suppress(Exception):
            read(data)
    finally:
        sys.settrace(None)
    return found
