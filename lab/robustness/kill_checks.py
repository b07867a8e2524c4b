"""What a killed command left: which files there are, whether each is whole, and whether it is what it should be."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors import safe_open

import pointsplat_ns as ps
from pointsplat_ns.io.formats import format_named
from pointsplat_ns.io.inert_yaml import read_config

TIMED = (".json", ".csv", ".html", ".md", ".tex", ".png")
"""Kinds of files that say when something was made and how long it took, or show it."""

LOGS = ("events.out", "losses-")
"""Starts of the names of files that a training logs to, line by line."""


def files_of(folder: Path) -> dict[str, Path]:
    """The files below a folder by their relative names, without logs. What is hidden is unfinished, or a lock, and is
    left out."""
    files = {path.relative_to(folder): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {
        str(name): path
        for name, path in files.items()
        if not any(part.startswith(".") for part in name.parts) and not name.name.startswith(LOGS)
    }


def without_times(path: Path) -> bytes:
    """What has to be the same in two files; of those with times in them, their suffix."""
    if path.suffix in TIMED:
        return path.suffix.encode()
    data = path.read_bytes()
    if path.suffix != ".safetensors":
        return data
    end = 8 + int.from_bytes(data[:8], "little")
    return json.dumps(json.loads(data[8:end]), sort_keys=True).encode() + data[end:]  # its header has no fixed order


def differences(folder: Path, whole: Path) -> list[str]:
    """How the files of a folder differ from those of an undisturbed command."""
    found, expected = files_of(folder), files_of(whole)
    faults = [f"lacks {name}" for name in sorted(expected.keys() - found.keys())]
    faults += [f"has {name} as well" for name in sorted(found.keys() - expected.keys())]
    both = sorted(expected.keys() & found.keys())
    return faults + [
        f"{name} has other bytes" for name in both if without_times(found[name]) != without_times(expected[name])
    ]


def not_whole(folder: Path) -> list[str]:
    """Files below a folder that are not what their names say, and why."""
    faults = []
    for path in files_of(folder).values():
        try:
            if not _whole(path):
                faults.append(f"{path.name} is not whole")
        except Exception as error:  # whatever a damaged file causes
            faults.append(f"{path.name} is not whole ({type(error).__name__}: {error})")
    return faults


def _decoded(path: Path) -> bool:
    with Image.open(path) as image:
        image.load()
    return True


def _frames(path: Path) -> bool:
    import av

    with av.open(str(path)) as video:
        return sum(1 for _ in video.decode(video=0)) > 0


def _tensors(path: Path) -> bool:
    with safe_open(path, framework="pt") as file:
        return len(list(file.keys())) > 0


def _same_length(path: Path) -> bool:
    return len({len(row) for row in csv.reader(io.StringIO(path.read_text()))}) == 1


CHECKS: dict[str, Callable[[Path], object]] = {
    ".ckpt": lambda path: torch.load(path, weights_only=True),
    ".glb": lambda path: path.stat().st_size == int.from_bytes(path.read_bytes()[8:12], "little"),
    ".json": lambda path: json.loads(path.read_bytes()) is not None,
    ".npy": lambda path: np.load(path) is not None,
    ".csv": _same_length,
    ".html": lambda path: path.read_bytes().rstrip().endswith(b"</html>"),
    **dict.fromkeys((".png", ".jpg", ".webp"), _decoded),
    ".yml": read_config,
    ".mp4": _frames,
    ".safetensors": _tensors,
    **dict.fromkeys((".md", ".tex", ".txt"), lambda path: path.stat().st_size > 0),
}
"""What is true of a whole file, by its suffix."""


def _whole(path: Path) -> bool:
    kind = format_named(path.name)
    if kind is not None and kind.read is not None and path.suffix not in (".ckpt", ".glb"):
        return len(ps.load(path)) > 0
    return bool(CHECKS[path.suffix](path))


def losses_of(folder: Path) -> dict[int, str]:
    """The losses of a training by step, those of a later attempt in place of those before."""
    losses: dict[int, str] = {}
    for path in sorted(folder.glob("losses-*.txt"), key=lambda path: int(path.stem.partition("-")[2])):
        for line in path.read_text().splitlines():
            step, _, loss = line.partition(" ")
            losses[int(step)] = loss
    return losses


def training_left(folder: Path) -> list[str]:
    """What is wrong with the checkpoints of a killed training: their steps have to be those in their names."""
    return [
        f"{path.name} holds another step"
        for path in folder.rglob("step-*.ckpt")
        if torch.load(path, weights_only=True)["step"] != int(path.stem.partition("-")[2])
    ]
