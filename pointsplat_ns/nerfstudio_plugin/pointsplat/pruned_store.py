"""Files of pruned scenes, so that further trainings on the same scenes need not prune them again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import file_stem, one_line, write_tensors
from pointsplat_ns.pruning import PruneSettings

FORMAT = "pointsplat-pruned/1"
"""Must change whenever the result of a pruning method changes, so that older files are not used."""


def stored_path(folder: Path, name: str, content: str, settings: PruneSettings) -> Path:
    """The path of a pruned scene's file, by the SHA-256 of the file that the dense scene is read from and by how it is
    pruned: a scene that is trained again has another one. The name is for people who look into the folder."""
    described = json.dumps([FORMAT, content, dataclasses.asdict(settings)], sort_keys=True)
    return folder / f"{file_stem(name)}-{hashlib.sha256(described.encode()).hexdigest()[:16]}.safetensors"


def write_pruned(path: Path, pruned: Gaussians, dense_count: int, seconds: float) -> None:
    """Write a pruned scene, the number of Gaussians of the dense scene, and the seconds that pruning took."""
    header = {"format": FORMAT, "dense_count": str(dense_count), "seconds": repr(seconds)}
    write_tensors(path, dict(pruned.items()), header)


def read_pruned(path: Path) -> tuple[Gaussians, int, float]:
    """The scene on the CPU, the dense count and the seconds of a file of :func:`write_pruned`. Raises SceneError if the
    file is damaged or of another kind."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise SceneError(f"{path}: format {header.get('format')!r}; expected {FORMAT!r}; remove the file")
            pruned = Gaussians(**{name: file.get_tensor(name) for name in file.keys()})
            return pruned, int(header["dense_count"]), float(header["seconds"])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"{path}: not a readable pruned scene ({one_line(error)}); remove the file") from error
