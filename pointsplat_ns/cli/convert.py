"""``pointsplat convert``: a scene in another format, turned and scaled."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, scene_result, written_size
from pointsplat_ns.system.quantities import seconds_text
from pointsplat_ns.system.terminal import say


def convert(
    scene: options.Scene,
    output: tyro.conf.Positional[Path],
    sh: Literal["all", "0", "1", "2", "3"] = "all",
    up: str | None = None,
    scale: float = 1.0,
    original_frame: bool = False,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Write a scene in another format. What formats lose stands in docs/formats.md.

    Args:
        scene: a file of any format (.ply, .compressed.ply, .spz, .sog or its folder, .splat), a
            Splatfacto checkpoint, or a run (its folder or config.yml).
        output: the file to write; its name says the format: .ply, .spz, .sog or .splat.
        sh: SH bands to keep: all, or up to a degree.
        up: the new up axis: x, y, z, -x, -y or -z. By default nothing is turned. The old up
            direction is estimated; -y:z names it as -y. Write --up=-y for a negative axis.
        scale: factor on positions and sizes.
        original_frame: for a Splatfacto run: undo nerfstudio's rotation, shift and scale of its
            data.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.pruning import cut_sh

    options.need_one_scene(scene)
    there = output.parent.exists()
    options.check_outputs(output, force)
    start = time.perf_counter()
    before = ps.load(scene)
    after = before if sh == "all" else cut_sh(before, int(sh))
    after = ps.place(after, up, scale, scene if original_frame else None)
    ps.save(after, output, progress=True, overwrite=True)
    seconds = time.perf_counter() - start
    if json_output:
        print_json(scene_result(len(before), after, seconds, output))
        return
    cut = f" cut to {after.sh_degree}" if after.sh_degree < before.sh_degree else ""
    degree = f"SH degree {before.sh_degree}{cut}"
    made = "" if there else ", in a new folder"
    say(
        f"{output}: {len(after):,} Gaussians, {degree}, {written_size(output)}, in "
        f"{seconds_text(seconds)}{made}"
    )
