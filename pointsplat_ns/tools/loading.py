"""Reads a scene of any kind: a file, a run, or a ``pointsplat`` run, whose scene is refined."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.pipeline.trained_refiner import (
    load_refiner,
    open_refiner_run,
    refine,
    scenes_of_run,
)
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.runs import may_be_run, open_run
from pointsplat_ns.tools.wording import log_lines


def load(path: str | Path, scene: str | None = None, data: str | Path | None = None) -> Gaussians:
    """Read a scene.

    Args:
        path: a scene file (``.ply``, compressed or not, ``.spz``, ``.sog`` or its folder,
            ``.splat``, ``.glb``, ``.gltf``, ``.rad``, 3D Tiles), a checkpoint of Splatfacto or
            gsplat, a Splatfacto run (its folder or ``config.yml``), or a ``pointsplat`` run, whose
            dense scene is pruned and refined as in its training.
        scene: name of a scene of a ``pointsplat`` run; by default the first held-out one, or else
            the first.
        data: folder of the scenes of a ``pointsplat`` run, if they have moved.

    Returns:
        The scene, float32 on the CPU, with log-scales and logits as in the file.

    Raises:
        SceneError: if the path is none of these, is damaged, or has no such scene.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[:100], f"{folder}/some.ply")
        ...     len(ps.load(f"{folder}/some.ply"))
        100
    """
    if not _is_refiner_run(path):
        if scene is not None:
            raise SceneError(f"scene {scene!r}: {path} is a single scene; expected no scene name")
        return read_scene(path)
    scenes, default = scenes_of_run(open_refiner_run(path, need_data=True, data=data))
    chosen = default if scene is None else scene
    if chosen not in scenes:
        raise SceneError(
            f"scene {chosen!r}: no such scene in {path}; expected one of {', '.join(scenes)}"
        )
    refiner = load_refiner(path)
    settings = refiner.settings
    refined = refine(settings.prune(read_scene(scenes[chosen])), refiner)
    pruned = f"pruned by {settings.by} (keep {settings.keep:g})"
    log_lines((f"{chosen}: {pruned} and refined, as in training",))
    return refined


def _is_refiner_run(path: str | Path) -> bool:
    try:
        return may_be_run(path) and open_run(path, need_data=False).is_refiner
    except SceneError:
        return False  # a single scene, or unreadable: read_scene raises the error
