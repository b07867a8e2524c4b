"""``pointsplat prune``: make a scene smaller."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_if_larger, print_json, print_result, scene_result
from pointsplat_ns.pipeline.options import PruneOptions
from pointsplat_ns.system.terminal import say

Jobs = Annotated[
    int | None,
    tyro.conf.arg(
        help="for a scene larger than memory: number of processes that share its parts; by default "
        "1."
    ),
]
Cluster = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="ADDRESS",
        help="for a scene larger than memory: dask cluster whose workers share its parts, such as "
        "tcp://host:8786, or a scheduler file; by default none.",
    ),
]


def prune(
    scene: options.Scene,
    how: options.Flat[PruneOptions],
    output: options.Output = None,
    force: options.Force = False,
    jobs: Jobs = None,
    cluster: Cluster = None,
    memory: options.Megabytes | None = None,
    verbose: options.Verbose = False,
    json_output: options.Json = False,
) -> None:
    """Make a scene smaller: merge neighbours, or keep the most important Gaussians. Needs no
    photos.

    Renders, if needed, use views from --poses, else from the run's dataset, else sampled views.

    Args:
        output: file to write; its suffix sets the format, as for convert. By default
            beside the scene, in its format: room_pruned.ply for room.ply, pruned.ply in the folder
            of a run.
        memory: memory limit, such as 8GB; by default the free memory. A PLY that needs more is
            merged in parts, with temporary files beside the output, from which a killed command
            resumes. With --jobs or --cluster the limit applies to each process.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.pipeline import run
    from pointsplat_ns.pipeline.quality import quality_of_file
    from pointsplat_ns.scene.formats import format_to_write
    from pointsplat_ns.scene.ply import PlyRows
    from pointsplat_ns.tools.wording import log_report, quality_details, quality_json

    instead = f"pointsplat compact {scene} --effort instant merges them all"
    options.need_one_scene(scene, instead)
    options.check_poses(how.poses)
    output = output or options.output_beside(scene, "pruned")
    options.check_outputs(output, force)
    how = replace(how, target_format=format_to_write(output).suffix)
    limit = None if memory is None else 1e6 * memory
    done = run.prune(
        scene, how, output=output, memory=limit, jobs=jobs, cluster=cluster, progress=True
    )
    log_report(done.report)
    in_parts = done.report.written is not None
    small: ps.Gaussians | PlyRows | None = PlyRows.open(output) if in_parts else done.report.scene
    assert small is not None
    if not in_parts:
        ps.save(done.report.scene, output, progress=True, overwrite=True, spz_version=how.spz)
    quality = None if in_parts else quality_of_file(done.judge, done.report.scene, output)
    before = done.report.count_before
    seconds = done.report.seconds
    if json_output:
        print_json({**scene_result(before, small, seconds, output), **quality_json(quality)})
        return
    print_result(how.by, [], before, small, seconds, output, quality, in_parts)
    print_if_larger(scene, output)
    if verbose and quality is not None:
        say(quality_details(quality))
