"""What a killed command left: which files there are, whether each is whole, and whether it is what it should be."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import torch

import pointsplat_ns as ps
from pointsplat_ns.io.formats import format_named
from pointsplat_ns.io.inert_yaml import read_config

_LOGS = ("events.out", "losses-")
_TIMED = (".json", ".csv", ".html", ".md", ".tex", ".png")
"""Kinds of files that say when something was made and how long it took, or show it."""


def files_of(folder: Path) -> dict[str, Path]:
    """The files below a folder by their relative names. What is hidden is unfinished, or a lock, and is left out; so is
    what a training logs line by line."""
    if not folder.is_dir():
        return {}
    files = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {
        name: path
        for name, path in files.items()
        if not any(part.startswith(".") for part in Path(name).parts)
        and not path.name.startswith(("events.out", "losses-"))
    }


def without_times(path: Path) -> bytes:
    """What has to be the same in two files; of those with times in them, their suffix."""
    if path.suffix in _TIMED:
        return path.suffix.encode()
    data = path.read_bytes()
    if path.suffix != ".safetensors":
        return data
    end = 8 + int.from_bytes(data[:8], "little")
    return json.dumps(json.loads(data[8:end]), sort_keys=True).encode() + data[end:]  # its header has no fixed order


def not_whole(folder: Path) -> list[tuple[Path, str]]:
    """Files below a folder that are not what their names say, and why."""
    faults = []
    for path in files_of(folder).values():
        try:
            _check(path)
        except Exception as error:  # whatever a damaged file causes
            faults.append((path, f"{type(error).__name__}: {error}"))
    return faults


def _check(path: Path) -> None:
    data = path.read_bytes()
    kind = format_named(path.name)
    if path.suffix == ".ckpt":
        torch.load(path, weights_only=True)
    elif path.suffix == ".glb":
        _need(len(data) == int.from_bytes(data[8:12], "little"), "of another length than it says")
    elif kind is not None and kind.read is not None:
        _need(len(ps.load(path)) > 0, "no Gaussians")
    elif path.suffix == ".json":
        json.loads(data)
    elif path.suffix == ".npy":
        np.load(path)
    elif path.suffix == ".csv":
        _need(len({len(row) for row in csv.reader(io.StringIO(data.decode()))}) == 1, "rows of several lengths")
    elif path.suffix == ".html":
        _need(data.rstrip().endswith(b"</html>"), "no end")
    elif path.suffix in (".png", ".jpg", ".webp"):
        from PIL import Image

        with Image.open(path) as image:
            image.load()
    elif path.suffix == ".yml":
        read_config(path)
    elif path.suffix == ".mp4":
        import av

        with av.open(str(path)) as video:
            _need(sum(1 for _ in video.decode(video=0)) > 0, "no frame")
    elif path.suffix == ".safetensors":
        from safetensors import safe_open

        with safe_open(path, framework="pt") as file:
            _need(len(list(file.keys())) > 0, "no tensor")
    else:
        _need(path.suffix in (".md", ".tex", ".txt") and len(data) > 0, "empty, or of a kind that is not known here")


def _need(condition: bool, why: str) -> None:
    if not condition:
        raise ValueError(why)


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
