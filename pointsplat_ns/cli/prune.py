"""``pointsplat prune``: make a scene smaller."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.cli.folders import folder_command
from pointsplat_ns.cli.printing import (
    Json,
    print_distributions,
    print_json,
    print_result,
    scene_result,
)
from pointsplat_ns.cli.scene_options import (
    Bands,
    Data,
    Megabytes,
    Output,
    Poses,
    Resolution,
    Scene,
    Up,
    check_poses,
    claim_outputs,
    need_no_folder_options,
    output_beside,
    scene_written,
)

if TYPE_CHECKING:
    from pointsplat_ns.compression.requests import PruneRequest
    from pointsplat_ns.io.ply import PlyRows


def prune(
    scene: Scene,
    output: Output = None,
    keep: str = "0.3",
    by: str = "merge",
    opacity_weight: float | None = None,
    sh: Bands = "all",
    clean: bool = False,
    poses: Poses = None,
    resolution: Resolution = None,
    up: Up = None,
    data: Data = None,
    plot: Path | None = None,
    dry_run: bool = False,
    force: bool = False,
    jobs: int | None = None,
    shard: str | None = None,
    memory: Megabytes | None = None,
    threads: int | None = None,
    verbose: bool = False,
    json_output: Json = False,
) -> None:
    """Make a scene smaller, or all scenes of a folder: merge neighbours, or keep the most important Gaussians. No
    photos are needed.

    If anything has to be rendered, cameras are those of --poses, else those of the run's dataset; if there are none,
    they are sampled.

    Args:
        scene: a file of any format, a checkpoint, a run (its folder or config.yml), or a folder of scenes.
        output: the file to write; its name says the format: .ply, .compressed.ply, .spz, .sog, .splat or .glb. By
            default beside the scene: room_pruned.ply for room.ply, pruned.ply in the folder of a run. For a folder of
            scenes, another folder; by default rooms_pruned beside rooms. Each result there has the format of its scene.
        keep: size of the result: a ratio (0.3), a percentage (30%), a count (50000 or 50k), the size of the file (12MB
            or 800kB; for .spz and .sog the count is searched for, which takes two or three times as long), or auto:35,
            the smallest scene whose renders reach 35 dB PSNR against those of the dense scene (auto alone means 35).
        by: merge replaces neighbours by one Gaussian each and is by far the best; every other method keeps Gaussians as
            they are: coverage (empties no region), paper (eq. 3), authors (the formula of its released code), opacity,
            volume, log-volume, area, random; lightgaussian and pup score by views of the scene.
        opacity_weight: lambda of paper, authors and log-volume: the weight of opacity; by default the paper's 0.3.
        sh: SH bands to keep: all, up to a degree, or auto, the lowest degree whose renders reach 40 dB.
        clean: first remove Gaussians that cannot be drawn or seen; --keep refers to the scene as read.
        poses: a file of cameras: cameras.json of 3DGS, transforms.json of nerfstudio, or the folder of a
            COLMAP project. They must be of this scene. By default the views of its dataset, or of such a file beside
            the scene, or sampled ones; none always samples them.
        resolution: size of the pictures that people look at, pixels. Decisions by rendering are made at this size. By
            default the size of the photos, if there are any, else 1920x1080.
        up: the axis that is up in the scene: x, y, z, -x, -y or -z, for views that are sampled; by default the
            file's own, or an estimate. Write --up=-y for a negative axis.
        data: folder of the run's photos and poses, or one above it, if it is no longer where the run says. In a folder
            of scenes, a run whose data is not found gets sampled views, which its note says.
        plot: a .png file for a plot of the distributions of opacity and volume, before and after; by default none.
        dry_run: compute and print everything, but write no scene.
        force: overwrite existing files.
        jobs: for a folder, or a scene merged in parts: number of processes that share scenes or parts, and the cores;
            by default 1.
        shard: for a folder: only a part of its scenes; 2/5 is the second of five; by default all.
        memory: how much memory may be taken, such as 8GB; by default what is free. A PLY that needs more is merged in
            parts, with files beside the output; a command that was killed resumes. With --jobs each process may take
            so much.
        threads: number of threads. By default it adapts to the work and to other programs. Another number may
            change results by rounding.
        verbose: print more: what was chosen for the scene, and the distributions of opacities and sizes.
        json_output: print the result as JSON, and nothing else on standard output.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.compacting import Looking, prune_source
    from pointsplat_ns.compression.prune_file import rows_to_prune
    from pointsplat_ns.compression.requests import PruneRequest
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.io.formats import format_to_write
    from pointsplat_ns.io.scene import is_folder_of_scenes
    from pointsplat_ns.system.threads import fixed_threads

    if is_folder_of_scenes(scene):
        from pointsplat_ns.folders import prune_folder
        from pointsplat_ns.scene_folder import output_folder

        one = {"--poses": poses, "--up": up, "--plot": plot, "--dry-run": dry_run, "--memory": memory}
        return folder_command(
            prune_folder, scene, output or output_folder(scene, "pruned"), one, json_output, jobs, threads,
            request=PruneRequest(keep, by, sh, opacity_weight, clean), resolution=resolution, data=data, shard=shard,
            force=force,
        )  # fmt: skip
    need_no_folder_options(scene, None, shard)
    check_poses(poses)
    output = output or output_beside(scene, "pruned")
    written = None if dry_run else output
    claim_outputs(written, force, plot)
    request = PruneRequest(keep, by, sh, opacity_weight, clean, format_to_write(output).budget_suffix)
    rows = rows_to_prune(scene, request, None if memory is None else 1e6 * memory)
    if rows is not None:
        if dry_run or plot is not None:
            raise SceneError(f"{scene}: does not fit into memory; expected neither --dry-run nor --plot")
        with fixed_threads(threads):
            _prune_in_parts(rows, output, request, memory, jobs, poses, resolution, up, json_output)
        return
    need_no_folder_options(scene, jobs, shard)
    with fixed_threads(threads):
        dense, small, seconds, quality = prune_source(
            scene, request, Looking(poses, resolution, up, data), progress=True, compared=True
        )
    if not dry_run:
        ps.save(small, output, progress=True)
    if plot is not None:
        with scene_written(written):
            ps.plot_distributions({"before": dense, "after": small}, plot)
    if json_output:
        compared = asdict(quality) if quality else {"psnr": None}
        print_json({**scene_result(len(dense), small, seconds, written), **compared, "plot": plot})
        return
    print_result(by, [], len(dense), small, seconds, written, quality)
    if verbose:
        print_distributions(dense, small)
    if plot is not None:
        print(f"{plot}: opacity and volume, before and after")


def _prune_in_parts(
    rows: PlyRows,
    output: Path,
    request: PruneRequest,
    memory: float | None,
    jobs: int | None,
    poses: Path | None,
    resolution: str | None,
    up: str | None,
    json_output: bool,
) -> None:
    """Prune a scene that does not fit into memory, and print the result."""
    from pointsplat_ns.compression.prune_file import prune_file
    from pointsplat_ns.io.ply import PlyRows
    from pointsplat_ns.looking.sizes import parse_resolution
    from pointsplat_ns.looking.upright import up_named
    from pointsplat_ns.system.progress import progress_bar

    size, limit = parse_resolution(resolution), None if memory is None else 1e6 * memory
    with progress_bar() as report:
        before, seconds = prune_file(
            rows, output, request, limit, poses, size, up_named(up), report, jobs=1 if jobs is None else jobs
        )
    small = PlyRows.open(output)
    assert small is not None
    if json_output:
        print_json({**scene_result(before, small, seconds, output), "psnr": None, "plot": None})
        return
    unknown = "not compared with the dense scene: it does not fit into memory"
    print_result(request.by, [], before, small, seconds, output, unknown)
