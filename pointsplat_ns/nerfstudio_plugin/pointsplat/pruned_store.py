"""Pruned scenes on disk, so that trainings on the same scenes need not prune them again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import one_line, replacing
from pointsplat_ns.pruning import PruneSettings

FORMAT = "pointsplat-pruned/1"
"""Changes whenever a method of pruning does, so that no file of an older one is taken."""


def stored_path(folder: Path, name: str, content: str, settings: PruneSettings) -> Path:
    """Where a scene that is pruned in some way belongs.

    Args:
        folder: of all pruned scenes.
        name: of the scene, for a person who looks into the folder.
        content: SHA-256 of the file that the dense scene is read from. A scene that is trained again has another,
            whatever its run is called.
        settings: how it is pruned.
    """
    described = json.dumps([FORMAT, content, dataclasses.asdict(settings)], sort_keys=True)
    readable = re.sub(r"[^\w.+-]+", "-", name).strip("-.") or "scene"
    return folder / f"{readable}-{hashlib.sha256(described.encode()).hexdigest()[:16]}.safetensors"


def write_pruned(path: Path, pruned: Gaussians, dense_count: int, seconds: float) -> None:
    """Writes a pruned scene, the number of Gaussians that it was made of, and the seconds that this took."""
    from safetensors.torch import save_file

    header = {"format": FORMAT, "dense_count": str(dense_count), "seconds": repr(seconds)}
    with replacing(path) as part:
        save_file({name: value.detach().cpu().contiguous() for name, value in pruned.items()}, part, metadata=header)


def read_pruned(path: Path) -> tuple[Gaussians, int, float]:
    """What :func:`write_pruned` wrote: the scene on the CPU, the dense count and the seconds.

    Raises:
        SceneError: if the file is damaged or of another kind.
    """
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
