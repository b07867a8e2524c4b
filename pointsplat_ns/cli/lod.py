"""``pointsplat lod``: make levels of detail."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json, psnr_text
from pointsplat_ns.pipeline.options import Bands, ViewOptions
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.system.terminal import print_table, say

if TYPE_CHECKING:
    from pointsplat_ns.tools.levels.levels import Levels


def lod(
    scene: options.Scene,
    view_options: options.Flat[ViewOptions],
    levels: tuple[str, ...] = ("50%", "25%", "10%", "3%"),
    output: options.Output = None,
    stream: bool = False,
    tiles: bool = False,
    at: str | None = None,
    spz_version: Literal[3, 2] | None = None,
    sh: Bands = "all",
    effort: Literal["instant", "quick", "thorough"] = "instant",
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Make levels of detail: merge the scene to fewer and fewer Gaussians in one pass, and measure
    each level.

    With --stream, the whole scene and the levels become a streamed SOG, from which viewers load
    only the necessary parts. With --tiles, they become 3D Tiles.

    Each level is merged from the previous one, so every Gaussian has one parent in the next coarser
    level. Renders are compared with the dense scene's, in views from --poses, else from the run's
    dataset, else in sampled views.

    Args:
        levels: sizes of the levels, in any order: ratios (0.3), percentages (30%), counts (50000)
            or file sizes (12MB).
        output: folder for the levels (level_0.ply is the finest) and the manifest lod.json; by
            default beside the scene: room_lod for room.ply, lod in the folder of a run. With
            --stream, folder for lod-meta.json and SOG files, by default room_stream; with --tiles,
            folder for tileset.json and glTF files, by default room_tiles. A name that ends in .rad
            is a file for Spark.
        stream: write a streamed SOG (PlayCanvas, SuperSplat, Babylon). The scene itself is its
            finest level.
        tiles: write 3D Tiles of glTF with SPZ (CesiumJS). The scene itself is their finest level.
        at: place of the tiles on the Earth: UTM zone of the scene's coordinates (EPSG:32632), or
            latitude, longitude and height of its origin in degrees and metres (48.86,2.29,35;
            --at=-33.9,... in the south), with up rotated to the zenith. By default tiles keep the
            frame of the scene's file.
        spz_version: version of the SPZ in --tiles: 3, the newest that CesiumJS reads, or 2; by
            default 3.
        sh: SH bands of every level: all, a maximum degree, or auto, the lowest degree whose renders
            reach 40 dB.
        effort: length of the repair of each level, as for compact: none (instant), quick, or
            thorough.
        json_output: print the manifest and nothing else on standard output.
    """
    options.need_scenes(scene)
    import pointsplat_ns as ps
    from pointsplat_ns.scene.discovery import FOLDER_FILES
    from pointsplat_ns.scene.formats.gltf import SPZ_INSIDE

    options.need_one_scene(scene)
    options.check_poses(view_options.poses)
    folder = output or options.output_beside(
        scene, "stream" if stream else "tiles" if tiles else "lod", ""
    )
    for_viewers = stream or tiles or folder.suffix.lower() == ".rad"
    made = ps.lod(
        scene,
        ("100%", *levels) if for_viewers else levels,
        sh=sh,
        effort=effort,
        views=view_options.poses,
        resolution=view_options.resolution,
        up=view_options.up,
        data=view_options.data,
        folder=folder,
        stream=stream,
        tiles=tiles,
        at=at,
        spz_version=spz_version,
        force=force,
        progress=True,
    )
    if json_output and for_viewers:
        print_json({"output": folder, "levels": [level.facts(len(made.dense)) for level in made]})
    elif json_output:
        print_json(
            {"output": folder, **json.loads((folder / FOLDER_FILES.levels).read_text("utf-8"))}
        )
    else:
        _print_table(made, folder, (spz_version or SPZ_INSIDE) if tiles else None)
    if made.interrupted:
        raise KeyboardInterrupt  # once the levels are written and printed


def _print_table(made: Levels, folder: Path, spz_version: int | None) -> None:
    """Print the levels, and the version of the SPZ in tiles; None for no tiles."""
    from pointsplat_ns.pruning import ply_bytes
    from pointsplat_ns.scene.discovery import FOLDER_FILES
    from pointsplat_ns.system.files import bytes_text, three_digits
    from pointsplat_ns.tools.wording import impression, spz_tiles

    apart = (folder / FOLDER_FILES.levels).exists()  # every level has its own PLY
    rows = []
    for index, level in enumerate(made):
        near = level.quality
        rows.append(
            (
                f"level_{index}",
                f"{len(level.scene):,}",
                f"{100 * len(level.scene) / len(made.dense):.3g} %",
                three_digits(ply_bytes(len(level.scene), level.scene.sh_degree) / 1e6)
                if apart
                else "-",
                f"{level.seconds:.1f}",
                psnr_text(near.psnr if near else None),
                f"{near.ssim:.2f}" if near and near.ssim is not None else "-",
                impression(near.psnr) if near else "-",
            )
        )
    files = [path for path in (folder, *folder.rglob("*")) if path.is_file()]
    size = bytes_text(sum(path.stat().st_size for path in files))
    say(f"{folder}: {counted(len(made), 'level')} of {len(made.dense):,} Gaussians, {size} in all")
    if spz_version is not None:
        say(spz_tiles(spz_version))
    header = ("", "Gaussians", "share", "MB", "seconds", "dB", "SSIM", "")
    print_table(header, rows, "dB: PSNR against the dense scene", left=(0, 7))
