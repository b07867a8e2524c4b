"""``pointsplat export``: write the scene of a run to a file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, scene_result, written_size
from pointsplat_ns.system.quantities import seconds_text
from pointsplat_ns.system.terminal import say


def export(
    run: tyro.conf.Positional[Path],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    scene: str | None = None,
    data: options.Data = None,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Write the refined scene of a pointsplat run, or the trained scene of a Splatfacto run, to a
    file of any format.

    Args:
        run: folder, config.yml or checkpoint of the run.
        output: file to write, of any format as for prune.
        scene: name of a scene of a pointsplat run; by default the first held-out one, or else the
            first.
        data: folder of the scenes of a pointsplat run, or a folder above it, if they have moved.
    """
    options.need_scenes(run)
    import pointsplat_ns as ps

    options.check_outputs(output, force)
    start = time.perf_counter()
    exported = ps.load(run, scene, data)
    ps.save(exported, output, progress=True, overwrite=True)
    seconds = time.perf_counter() - start
    if json_output:
        print_json(scene_result(None, exported, seconds, output))
        return
    say(
        f"{output}: {len(exported):,} Gaussians, {written_size(output)}, in {seconds_text(seconds)}"
    )
