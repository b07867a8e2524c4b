"""Options that the benchmarks of the rasterizer and of the refiner share, and the file that they write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch


@dataclass
class Options:
    """Where something runs, and where its figures go."""

    threads: int | None = None
    """Threads of torch; its own choice by default. A C++ peer always has one."""
    device: str = "cpu"
    """Where our own code runs."""
    json: Path | None = None
    """Write all figures here."""
    plot: Path | None = None
    """Draw the figures here, as a PNG."""


def write_json(options: Options, settings: dict[str, Any], cases: list[dict[str, Any]]) -> None:
    """Write what was measured so far, if that is asked for; called after each case, so that an interrupted run leaves
    something."""
    if options.json is None:
        return
    content: dict[str, Any] = {"torch": torch.__version__, "device": options.device, "threads": torch.get_num_threads()}
    options.json.write_text(json.dumps({**content, **settings, "cases": cases}, indent=1) + "\n", "utf-8")
