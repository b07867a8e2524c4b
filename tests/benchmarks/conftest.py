"""The benchmarks' modules, which lie beside one another and in no package."""

from __future__ import annotations

import importlib
import runpy
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


@pytest.fixture()
def run_benchmark(benchmark, monkeypatch, capsys) -> Callable[..., str]:
    """A function that runs a benchmark, by its name and its arguments, and gives what it prints.

    It runs in this process, where what takes seconds to import is there already.
    """

    def run(name: str, *words: object) -> str:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", [f"{name}.py", *map(str, words)])
            runpy.run_module(name, run_name="__main__")
        return capsys.readouterr().out

    return run
