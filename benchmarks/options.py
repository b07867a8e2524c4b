"""Options that the benchmarks of the rasterizer and of the refiner share, and the file that all benchmarks write."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.io.files import replacing


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
    content: dict[str, Any] = {"torch": torch.__version__, "device": options.device, "threads": torch.get_num_threads()}
    write_whole(options.json, {**content, **settings, "cases": cases})


def write_whole(path: Path | None, content: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all; no path, no file."""
    if path is not None:
        with replacing(path) as part:
            part.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
