"""``pointsplat convert``: write a scene in another format, rotated or scaled."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import (
    print_folder,
    print_json,
    print_readers,
    scene_result,
    written_size,
)
from pointsplat_ns.pipeline.options import SpzVersion
from pointsplat_ns.system.quantities import seconds_text
from pointsplat_ns.system.terminal import say


def convert(
    scene: options.Scenes,
    output: tyro.conf.Positional[Path | None] = None,
    to: str | None = None,
    sh: Literal["all", "0", "1", "2", "3"] = "all",
    up: str | None = None,
    scale: float = 1.0,
    original_frame: bool = False,
    spz_version: SpzVersion = 4,
    force: options.Force = False,
    jobs: options.Jobs = None,
    json_output: options.Json = False,
) -> None:
    """Write a scene in another format, or all scenes of a folder. docs/formats.md describes the
    losses of formats.

    A folder with config.yml is a run, with one scene. Any other folder is a folder of scenes, as
    for compact. Finished scenes are skipped, so the same command continues after an interruption.

    Args:
        output: file to write; its suffix sets the format: .ply, .spz, .sog, .splat, .glb, .gltf
            or .spz.glb (a .glb with SPZ inside). For a folder of scenes, another folder; by default
            rooms_spz beside rooms.
        to: for a folder, the format of the results, such as .spz.
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
    from pointsplat_ns.scene.reading import is_folder_of_scenes

    if is_folder_of_scenes(scene):
        changes = {
            "sh": sh,
            "up": up,
            "scale": scale,
            "original_frame": original_frame,
            "spz_version": spz_version,
        }
        return _convert_folder(scene, output, to, changes, force, jobs, json_output)
    if to is not None or jobs is not None:
        name = "--jobs" if to is None else "--to"
        raise ps.SceneError(f"{scene}: a single scene; {name} is for a folder of scenes")
    if output is None:
        raise ps.SceneError(f"{scene}: expected the file to write behind it, such as scene.spz")
    there = output.parent.exists()
    options.check_outputs(output, force)
    start = time.perf_counter()
    before = ps.load(scene)
    after = before if sh == "all" else cut_sh(before, int(sh))
    after = ps.place(after, up, scale, scene if original_frame else None)
    ps.save(after, output, progress=True, overwrite=True, spz_version=spz_version)
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


def _convert_folder(
    scene: Path,
    output: Path | None,
    to: str | None,
    changes: dict[str, Any],
    force: bool,
    jobs: int | None,
    json_output: bool,
) -> None:
    """Convert all scenes of a folder, and print a table of the results."""
    import pointsplat_ns as ps
    from pointsplat_ns.tools.folders import output_folder

    if to is None:
        raise ps.SceneError(
            f"{scene}: a folder of scenes; expected the format of the results, such as --to .spz"
        )
    folder = output or output_folder(scene, to.removeprefix("."))
    results = ps.convert_folder(
        scene,
        to,
        folder,
        **changes,
        jobs=1 if jobs is None else jobs,
        force=force,
        progress=True,
    )
    print_folder(results, folder, [], json_output, compared=False)
