"""``pointsplat convert``: write a scene in another format, rotated or scaled."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, print_readers, scene_result, written_size
from pointsplat_ns.pipeline.options import SpzVersion
from pointsplat_ns.system.quantities import seconds_text
from pointsplat_ns.system.terminal import say


def convert(
    scene: options.Scene,
    output: tyro.conf.Positional[Path],
    sh: Literal["all", "0", "1", "2", "3"] = "all",
    up: str | None = None,
    scale: float = 1.0,
    original_frame: bool = False,
    spz_version: SpzVersion = 4,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Write a scene in another format. docs/formats.md describes the losses of formats.

    Args:
        scene: file of any format (.ply, .compressed.ply, .spz, .sog or its folder, .splat, .glb,
            .gltf, .rad, tileset.json or its folder), Splatfacto checkpoint, or run (its folder or
            config.yml).
        output: file to write; its suffix sets the format: .ply, .spz, .sog, .splat, .glb, .gltf
            or .spz.glb (a .glb with SPZ inside).
        sh: SH bands to keep: all, or a maximum degree.
        up: new up axis: x, y, z, -x, -y or -z; by default nothing is rotated. The old up direction
            is declared by the file, or estimated; -y:z gives it as -y. Write --up=-y for a negative
            axis.
        scale: factor on positions and sizes.
        original_frame: undo nerfstudio's rotation, translation and scale of the data of a
            Splatfacto run.
        spz_version: version of an .spz: 4, which the format's own library, SuperSplat, PlayCanvas
            and three.js read; 3 for Spark 2.2 and older viewers; or 2 for viewers from before 2025.
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
    ps.save(after, output, True, overwrite=True, spz_version=spz_version)
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
    print_readers(output)
