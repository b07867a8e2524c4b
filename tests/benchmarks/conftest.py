"""The benchmarks' modules, which lie beside one another and in no package."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from types import ModuleType

import pytest

from making import BENCHMARKS


@pytest.fixture(scope="session")
def benchmark() -> Iterator[Callable[[str], ModuleType]]:
    """A function that imports a module of benchmarks/ by its name."""
    sys.path.append(str(BENCHMARKS))  # last: their short names hide nothing
    try:
        yield importlib.import_module
    finally:
        sys.path.remove(str(BENCHMARKS))
