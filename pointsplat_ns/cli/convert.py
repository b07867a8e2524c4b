"""``pointsplat convert``: a scene in another format, turned and scaled."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.folders import folder_command
from pointsplat_ns.cli.printing import print_json, scene_result, written_size
from pointsplat_ns.system.quantities import seconds_text


def convert(
    scene: options.Scenes,
    output: tyro.conf.Positional[Path],
    sh: Literal["all", "0", "1", "2", "3"] = "all",
    up: str | None = None,
    scale: float = 1.0,
    original_frame: bool = False,
    recentre: bool = False,
    offset: tuple[float, float, float] | None = None,
    to: str | None = None,
    force: options.Force = False,
    jobs: options.Jobs = None,
    json_output: options.Json = False,
) -> None:
    """Write a scene in another format, or all scenes of a folder. What formats lose stands in docs/formats.md.

    Args:
        scene: a file of any format (.ply, .compressed.ply, .spz, .sog or its folder, .splat), a Splatfacto
            checkpoint, a run (its folder or config.yml), or a folder of scenes.
        output: the file to write; its name says the format: .ply, .compressed.ply, .spz, .sog, meta.json (a SOG as a
            folder) or .splat. For a folder of scenes, another folder.
        sh: SH bands to keep: all, or up to a degree.
        up: the new up axis: x, y, z, -x, -y or -z. By default nothing is turned. The old up direction is estimated;
            -y:z names it as -y. Write --up=-y for a negative axis.
        scale: factor on positions and sizes.
        original_frame: for a Splatfacto run: undo nerfstudio's rotation, shift and scale of its data.
        recentre: write positions relative to their rounded median, so that float32 keeps their digits. The offset is
            kept in .ply and .compressed.ply files.
        offset: write positions relative to this point of the scene's frame; 0 0 0 writes them in the frame itself.
        to: for a folder: the format of all results, such as .spz; by default none.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.io.scene import is_folder_of_scenes
    from pointsplat_ns.pruning import cut_sh

    if recentre and offset is not None:
        raise ps.PointSplatError("--recentre and --offset both given; expected one of them")
    point: Any = "centre" if recentre else offset
    if is_folder_of_scenes(scene):
        from pointsplat_ns.folders import convert_folder

        if to is None:
            raise ps.SceneError(f"{scene}: a folder of scenes; expected their new format, such as --to .spz")
        return folder_command(
            convert_folder, scene, output, {}, json_output, jobs,
            suffix=to, sh=sh, up=up, scale=scale, original_frame=original_frame, offset=point, force=force,
        )  # fmt: skip
    options.need_no_jobs(scene, jobs)
    if to is not None:
        raise ps.SceneError(f"{scene}: one scene; --to is for a folder of scenes, the name of {output} says its format")
    options.claim_outputs(output, force)
    start = time.perf_counter()
    before = ps.load(scene)
    after = before if sh == "all" else cut_sh(before, int(sh))
    after = ps.place(after, up, scale, scene if original_frame else None, point)
    ps.save(after, output, progress=True, overwrite=True)
    seconds = time.perf_counter() - start
    if json_output:
        print_json(scene_result(len(before), after, seconds, output))
        return
    cut = f" cut to {after.sh_degree}" if after.sh_degree < before.sh_degree else ""
    degree = f"SH degree {before.sh_degree}{cut}"
    if point is not None and after.offset is not None:
        print(f"positions are relative to {' '.join(map(repr, after.offset))}")
    print(f"{output}: {len(after):,} Gaussians, {degree}, {written_size(output)}, in {seconds_text(seconds)}")
