"""``pointsplat prune``: make a scene smaller."""

from __future__ import annotations

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_if_larger, print_json, print_result, scene_result
from pointsplat_ns.system.terminal import say


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
    force: options.Force = False,
    jobs: options.Jobs = None,
    memory: options.Megabytes | None = None,
    verbose: options.Verbose = False,
    json_output: options.Json = False,
) -> None:
    """Make a scene smaller: merge neighbours, or keep the most important Gaussians. No photos are
    needed.

    If anything has to be rendered, cameras are those of --poses, else those of the run's dataset;
    if there are none, they are sampled.

    Args:
        output: the file to write; its name says the format: .ply, .spz, .sog or .splat. By
            default in the scene's format and beside it: room_pruned.ply for room.ply, pruned.ply in
            a run's folder.
        keep: size of the result: a ratio (0.3), a percentage (30%), a count (50000 or 50k), the
            size of the file (12MB or 800kB; for .spz and .sog the count is searched for, which
            takes two or three times as long), or auto:35, the smallest scene whose renders reach 35
            dB PSNR against those of the dense scene (auto alone means 35).
        by: merge replaces neighbours by one Gaussian each and is by far the best; every other
            method keeps Gaussians as they are: coverage (empties no region), paper (eq. 3), authors
            (the formula of its released code), opacity, random; lightgaussian and pup score by
            views of the scene.
        opacity_weight: lambda of paper and authors: the weight of opacity; by default the paper's
            0.3.
        sh: SH bands to keep: all, up to a degree, or auto, the lowest degree whose renders reach 40
            dB.
        clean: first remove Gaussians that cannot be drawn or seen; --keep refers to the scene as
            read.
        photos: also print PSNR in held-out photos: of the dataset of a run, or every eighth photo,
            by name, in FOLDER. Nothing is trained. Its poses, those of --poses or of a file of
            cameras there, above it or beside the scene, are then the views.
        memory: how much memory may be taken, such as 8GB; by default what is free. A PLY that needs
            more is merged in parts, with files beside the output; a command that was killed
            resumes. With --jobs each process may take so much.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.pipeline.options import PruneRequest
    from pointsplat_ns.pipeline.prune_file import prune_file, rows_to_prune
    from pointsplat_ns.pipeline.quality import judge_of, quality_of_file
    from pointsplat_ns.pipeline.requests import Looking, prune_source
    from pointsplat_ns.rendering.comparison.sizes import parse_resolution
    from pointsplat_ns.scene.formats import format_to_write
    from pointsplat_ns.scene.ply import PlyRows
    from pointsplat_ns.system.progress import progress_bar
    from pointsplat_ns.view_sampling.upright import up_named

    options.need_one_scene(scene)
    options.check_poses(poses)
    output = output or options.output_beside(scene, "pruned")
    options.check_outputs(output, force)
    request = PruneRequest(keep, by, sh, opacity_weight, clean, format_to_write(output).suffix)
    limit = None if memory is None else 1e6 * memory
    rows = rows_to_prune(scene, request, limit)
    small: ps.Gaussians | PlyRows
    if rows is None:
        if jobs is not None:
            raise ps.SceneError(
                f"{scene}: fits into memory; --jobs is for a scene that is merged in parts"
            )
        looking = Looking(poses, resolution, up, data, photos)
        dense, small, seconds, source = prune_source(scene, request, looking, progress=True)
        before = len(dense)
        ps.save(small, output, progress=True, overwrite=True)
        quality = quality_of_file(judge_of(dense, source), small, output)
    elif photos is not False:
        raise ps.SceneError(f"{scene}: does not fit into memory; expected no --photos")
    else:
        processes = 1 if jobs is None else jobs
        size = parse_resolution(resolution)
        with progress_bar() as report:
            before, seconds = prune_file(
                rows, output, request, limit, poses, size, up_named(up), report, processes
            )
        written = PlyRows.open(output)
        quality = None
        assert written is not None
        small = written
    if json_output:
        compared = quality.as_dict() if quality else {"psnr": None}
        print_json({**scene_result(before, small, seconds, output), **compared})
        return
    unknown = "not compared with the dense scene: it does not fit into memory"
    print_result(by, [], before, small, seconds, output, quality if rows is None else unknown)
    print_if_larger(scene, output)
    if verbose and quality is not None:
        say(quality.details)
