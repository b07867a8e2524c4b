"""Subcommands that turn one scene into another: prune, refine, export."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Literal

import tyro

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Scene = tyro.conf.Positional[Path]


def _say(what: str, dense: int, kept, seconds: float, path: Path) -> None:
    share = f" ({100 * len(kept) / dense:.1f} %)" if dense else ""
    print(f"{path}: {what} {len(kept):,} of {dense:,} Gaussians{share}, {kept.megabytes:.2f} MB, in {seconds:.1f} s")


def prune(
    scene: Scene,
    output: Output,
    keep: str = "0.3",
    by: Literal["paper", "opacity", "volume", "random"] = "paper",
    opacity_weight: float = 0.3,
) -> None:
    """Keep the Gaussians of a scene that matter, by a score over their own attributes.

    Args:
        scene: a 3DGS .ply, a Splatfacto checkpoint, or a Splatfacto run (its folder or config.yml).
        output: the .ply to write.
        keep: how many: a ratio (0.3), a percentage (30%) or a count (50000).
        by: the score; paper is eq. 3, the weighted sum of z-scored opacity and volume.
        opacity_weight: lambda of the paper's score.
    """
    from pointsplat_ns.io.scene import read_scene, write_scene
    from pointsplat_ns.pruning import parse_keep
    from pointsplat_ns.pruning import prune as choose

    options = {"opacity_weight": opacity_weight} if by == "paper" else {}
    dense = read_scene(scene)
    start = time.perf_counter()
    kept = choose(dense, parse_keep(keep), by, **options).scene
    seconds = time.perf_counter() - start
    write_scene(kept, output)
    _say("kept", len(dense), kept, seconds, output)


def refine(scene: Scene, using: Path, output: Output, keep: str | None = None) -> None:
    """Prune any scene and repair it with a trained refiner. No photos are needed.

    Args:
        scene: a 3DGS .ply, a Splatfacto checkpoint, or a Splatfacto run (its folder or config.yml).
        using: a trained pointsplat run: its folder or config.yml.
        output: the .ply to write.
        keep: how many Gaussians, as for prune; by default what the refiner was trained with.
    """
    from pointsplat_ns.io.scene import read_scene, write_scene
    from pointsplat_ns.pruning import parse_keep
    from pointsplat_ns.refined_run import open_refined_run

    trained = open_refined_run(using, need_scenes=False)
    dense = read_scene(scene)
    start = time.perf_counter()
    refined = trained.compact(dense, None if keep is None else parse_keep(keep))
    seconds = time.perf_counter() - start
    write_scene(refined, output)
    _say("refined", len(dense), refined, seconds, output)


def export(run: Scene, output: Output, scene: str | None = None) -> None:
    """Write the refined scene of a pointsplat run, or the trained one of a Splatfacto run, as a 3DGS .ply.

    Args:
        run: the run's folder, config.yml or checkpoint.
        output: the .ply to write.
        scene: which scene of a pointsplat run; by default the first that it was not trained on, or the first.
    """
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.io.runs import open_run
    from pointsplat_ns.io.scene import read_scene, write_scene
    from pointsplat_ns.refined_run import METHOD, open_refined_run

    start = time.perf_counter()
    try:
        method = open_run(run, need_data=False).method_name
    except SceneError:
        method = ""  # a scene that stands alone, or nothing that can be read: read_scene says which
    if method == METHOD:
        trained = open_refined_run(run)
        chosen = scene or trained.default_scene
        if chosen not in trained.scenes:
            raise SceneError(f"--scene {chosen}: no such scene in {run}; there are {', '.join(trained.scenes)}")
        dense = read_scene(trained.scenes[chosen].checkpoint)
        result, what = trained.compact(dense), f"{chosen}, refined:"
    else:
        if scene is not None:
            raise SceneError(f"--scene {scene}: {run} holds one scene; leave the option out")
        dense = result = read_scene(run)
        what = "wrote"
    write_scene(result, output)
    _say(what, len(dense), result, time.perf_counter() - start, output)
