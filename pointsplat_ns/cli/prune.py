"""``pointsplat prune``: make a scene smaller."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import (
    print_if_larger,
    print_json,
    print_result,
    scene_result,
)


def prune(
    scene: options.Scene,
    output: options.Output = None,
    keep: str = "0.3",
    by: str = "merge",
    opacity_weight: float | None = None,
    sh: options.Bands = "all",
    clean: bool = False,
    poses: options.Poses = None,
    resolution: options.Resolution = None,
    up: options.Up = None,
    data: options.Data = None,
    photos: options.Photos = False,
    plot: Path | None = None,
    dry_run: bool = False,
    force: options.Force = False,
    memory: options.Megabytes | None = None,
    threads: options.Threads = None,
    verbose: options.Verbose = False,
    json_output: options.Json = False,
) -> None:
    """Make a scene smaller: merge neighbours, or keep the most important Gaussians. No photos are needed.

    If anything has to be rendered, cameras are those of --poses, else those of the run's dataset; if there are none,
    they are sampled.

    Args:
        output: the file to write; its name says the format: .ply, .spz, .sog or .splat. By
            default in the scene's format and beside it: room_pruned.ply for room.ply, pruned.ply in a run's folder.
        keep: size of the result: a ratio (0.3), a percentage (30%), a count (50000 or 50k), the size of the file (12MB
            or 800kB; for .spz and .sog the count is searched for, which takes two or three times as long), or auto:35,
            the smallest scene whose renders reach 35 dB PSNR against those of the dense scene (auto alone means 35).
        by: merge replaces neighbours by one Gaussian each and is by far the best; every other method keeps Gaussians as
            they are: coverage (empties no region), paper (eq. 3), authors (the formula of its released code), opacity,
            random; lightgaussian and pup score by views of the scene.
        opacity_weight: lambda of paper and authors: the weight of opacity; by default the paper's 0.3.
        sh: SH bands to keep: all, up to a degree, or auto, the lowest degree whose renders reach 40 dB.
        clean: first remove Gaussians that cannot be drawn or seen; --keep refers to the scene as read.
        photos: also print PSNR in held-out photos: of the dataset of a run, or every eighth photo, by name, in FOLDER.
            Nothing is trained. Its poses, those of --poses or of a file of cameras there, above it or beside the scene,
            are then the views.
        plot: a .png file for a plot of the distributions of opacity and volume, before and after; by default none.
        dry_run: compute and print everything, but write no scene.
        memory: how much memory may be taken, such as 8GB; by default what is free. A PLY that needs more is merged in
            parts, with files beside the output; a command that was killed resumes.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.compacting import Looking, prune_source
    from pointsplat_ns.comparing.sizes import parse_resolution
    from pointsplat_ns.compression.prune_file import prune_file, rows_to_prune
    from pointsplat_ns.compression.quality import quality_of_file
    from pointsplat_ns.compression.requests import PruneRequest
    from pointsplat_ns.io.formats import format_to_write
    from pointsplat_ns.io.ply import PlyRows
    from pointsplat_ns.looking.upright import up_named
    from pointsplat_ns.system.progress import progress_bar
    from pointsplat_ns.system.threads import fixed_threads

    options.need_one_scene(scene)
    options.check_poses(poses)
    output = output or options.output_beside(scene, "pruned")
    written = None if dry_run else output
    options.check_outputs(written, force, plot)
    suffix = format_to_write(output).suffix
    request = PruneRequest(keep, by, sh, opacity_weight, clean, suffix)
    limit = None if memory is None else 1e6 * memory
    rows = rows_to_prune(scene, request, limit)
    dense: ps.Gaussians | None = None
    small: ps.Gaussians | PlyRows | None
    with fixed_threads(threads):
        if rows is None:
            looking = Looking(poses, resolution, up, data, photos)
            dense, pruned, seconds, source = prune_source(scene, request, looking, progress=True)
            small, before = pruned, len(dense)
            if not dry_run:
                ps.save(pruned, output, progress=True, overwrite=True)
            quality = quality_of_file(dense, source, pruned, written, suffix)
            if plot is not None:
                ps.plot_distributions({"before": dense, "after": pruned}, plot)
        elif dry_run or plot is not None or photos is not False:
            raise ps.SceneError(f"{scene}: does not fit into memory; expected no --dry-run, --plot or --photos")
        else:
            size = parse_resolution(resolution)
            with progress_bar() as report:
                before, seconds = prune_file(rows, output, request, limit, poses, size, up_named(up), report)
            small, quality = PlyRows.open(output), None
    assert small is not None
    if json_output:
        compared = quality.as_dict() if quality else {"psnr": None}
        print_json({**scene_result(before, small, seconds, written), **compared, "plot": plot})
        return
    unknown = "not compared with the dense scene: it does not fit into memory"
    print_result(by, [], before, small, seconds, written, quality if rows is None else unknown)
    print_if_larger(scene, written)
    if verbose and quality is not None:
        print(quality.details)
    if plot is not None:
        print(f"{plot}: opacity and volume, before and after")
