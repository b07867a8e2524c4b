"""How tests run a program of the lab."""

from __future__ import annotations

import runpy
import sys
import warnings
from collections.abc import Callable

import pytest


@pytest.fixture()
def run_program(monkeypatch, capsys) -> Callable[..., str]:
    """A function that runs a program, by its module below ``lab`` and its arguments, and gives what it prints.

    It runs in this process, where what takes seconds to import is there already.
    """

    def run(name: str, *words: object) -> str:
        with monkeypatch.context() as patch, warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # the module may be imported already
            patch.setattr(sys, "argv", [f"{name}.py", *map(str, words)])
            runpy.run_module(f"lab.{name}", run_name="__main__")
        return capsys.readouterr().out

    return run
