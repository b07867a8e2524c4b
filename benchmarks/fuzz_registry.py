"""The readers that are fuzzed, by name; :mod:`fuzz_readers` and :mod:`fuzz_texts` enter them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

Read = Callable[[bytes], object]
"""Reads the bytes of one file, or raises."""

READERS: dict[str, Callable[[Path], Read]] = {}
"""By name, what makes the function of a reader in an empty folder."""


def reader(make: Callable[[Path], Read]) -> Callable[[Path], Read]:
    """Enter a reader under the name of its function."""
    READERS[make.__name__.replace("_", "-")] = make
    return make
