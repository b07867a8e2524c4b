"""``pointsplat compact``: make a scene smaller and refine it in one go."""

from __future__ import annotations

import time
from pathlib import Path

from pointsplat_ns.cli.scenes import (
    Bands,
    Method,
    OptionalOutput,
    Scene,
    need_outputs,
    progress_bar,
    say,
    show_distributions,
    write_unless_dry,
)

SHOWN_VIEWS = 3
"""Views in the picture, spread over those compared."""


def compact(
    scene: Scene,
    output: OptionalOutput = None,
    keep: str | None = None,
    using: Path | None = None,
    by: Method | None = None,
    sh: Bands = "all",
    picture: Path | None = None,
    dry_run: bool = False,
) -> None:
    """Make any scene smaller and repair it with a trained refiner. No photos are needed.

    The smaller scene, with and without refinement, is rendered beside the dense one from the poses of the run's dataset
    where it is at hand, else from free places within the scene. Refinement is taken as far as it comes closer to the
    dense scene, and left out where it does not help.

    Args:
        scene: a 3DGS .ply, a Splatfacto checkpoint, or a Splatfacto run (its folder or config.yml).
        output: the .ply to write.
        keep: how much, as for prune: 0.1, 10%, 50000, 12MB, or auto:35, which is met before refinement, so that
            refinement can only do better. By default what the refiner was trained with.
        using: a trained pointsplat run (its folder or config.yml), or a .safetensors file; by default the refiner that
            ships.
        by: the method of prune; by default the one that the refiner was trained with.
        sh: SH bands to keep, as for prune: all, up to a degree, or auto.
        picture: a .png to draw some views in: dense, before and after refinement, side by side.
        dry_run: find and say everything, but write no scene.
    """
    import torch

    from pointsplat_ns.compaction import Poses
    from pointsplat_ns.io.scene import read_scene
    from pointsplat_ns.pruning import parse_keep
    from pointsplat_ns.shipped import compact_and_refine, load_shipped, load_trained

    need_outputs(output, picture, dry_run)
    budget = None if keep is None else parse_keep(keep)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    trained = load_shipped(device) if using is None else load_trained(using, device)
    dense = read_scene(scene)
    start = time.perf_counter()
    with progress_bar() as told:
        made = compact_and_refine(dense, trained, budget, by, sh, Poses(scene, dense), told)
    seconds = time.perf_counter() - start
    where = write_unless_dry(made.scene, output, dry_run)
    say("kept and refined" if made.helped else "kept", len(dense), made.scene, seconds, where)
    print(made.verdict)
    for note in made.notes:
        print(note)
    show_distributions(dense, made.scene)
    if picture is not None:
        draw_comparison(dense, made, picture)


def draw_comparison(dense, made, path: Path) -> None:
    """Draw some of the views compared, dense, before and after refinement; print where, or why not."""
    import torch

    from pointsplat_ns.cli.pictures import side_by_side
    from pointsplat_ns.pruning import ply_bytes
    from pointsplat_ns.views import draw

    if made.reference is None:
        print(f"{path}: not drawn, as there is no view to draw")
        return

    def title(name: str, scene, close) -> str:
        size = f"{len(scene):,} Gaussians, {ply_bytes(len(scene), scene.sh_degree) / 1e6:.2f} MB"
        return f"{name}: {size}" + (f", {close.psnr:.2f} dB" if close is not None else "")

    views, pictures = made.reference.views, made.reference.pictures
    shown = torch.linspace(0, len(views) - 1, min(SHOWN_VIEWS, len(views))).round().int().tolist()
    titles = [title("dense", dense, None), title("before refinement", made.compacted, made.before)]
    scenes = [made.compacted]
    if made.after is not None:
        share = "" if made.strength == 1 else f" at {made.strength:.0%}"
        titles.append(title(f"refined{share}" if made.helped else "refined (left out)", made.refined, made.after))
        scenes.append(made.refined)
    with torch.no_grad():
        rows = [[pictures[i].cpu(), *(draw(scene, views, i).cpu() for scene in scenes)] for i in shown]
    side_by_side(rows, titles, path)
    print(f"{path}: {', '.join(title.split(':')[0] for title in titles)}, side by side")
