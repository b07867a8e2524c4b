"""``pointsplat info``: print figures of scenes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import print_json
from pointsplat_ns.system.terminal import say

if TYPE_CHECKING:
    from pointsplat_ns.tools.scene_info import SceneInfo


def info(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    views: Path | None = None,
    resolution: options.Resolution = None,
    up: options.Up = None,
    data: options.Data = None,
    force: options.Force = False,
    json_output: options.Json = False,
) -> None:
    """Print figures of scenes: format and size, counts, SH, up, fill, opacities, sizes, bounds, and
    suspicious rows. Several scenes, and folders of scenes, give a table.

    Args:
        scenes: files of any format, checkpoints, runs (their folder or config.yml), or folders of
            scenes.
        views: .png file with the views that other commands use without --poses, for a single scene;
            by default none.
        json_output: print JSON and nothing else on standard output: an object, or a list for
            several scenes.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.errors import PointSplatError

    if not any(map(os.path.exists, scenes)):
        options.need_scenes(*scenes)
    options.check_outputs(None, force, views)
    scenes = tuple(path for scene in scenes for path in _scenes_of(scene))
    if not scenes or (views is not None and len(scenes) > 1):
        raise PointSplatError(
            f"{len(scenes)} scenes; expected {'one' if views else 'at least one'}"
        )
    found: list[SceneInfo] = []
    failed: list[dict[str, str]] = []
    for scene in scenes:
        try:
            found.append(ps.info(scene, resolution=resolution, up=up))
        except PointSplatError as error:
            if len(scenes) == 1:
                raise
            say(f"error: {error}", error=True)
            failed.append({"file": str(scene), "error": str(error)})
    sheet = None
    if views is not None:
        sheet = ps.plot_views(scenes[0], views, resolution=resolution, up=up, data=data)
    if json_output:
        rows = [*(one.as_dict() for one in found), *failed]
        print_json(rows if len(rows) > 1 else rows[0])
    elif len(scenes) == 1:
        _print(found[0])
    elif found:
        _print_table(found)
    if sheet is not None and not json_output:
        say(sheet)
    if failed:
        raise PointSplatError(f"{len(failed)} of {len(scenes)} scenes cannot be read")


def _scenes_of(path: Path) -> list[Path]:
    """The scene at a path, or the scenes of a folder."""
    from pointsplat_ns.scene.discovery import find_scenes
    from pointsplat_ns.scene.reading import is_folder_of_scenes

    return [*find_scenes(path).values()] if is_folder_of_scenes(path) else [path]


def _print_table(found: list[SceneInfo]) -> None:
    """Print a line per scene, sizes in MB."""
    from pointsplat_ns.system.files import three_digits
    from pointsplat_ns.system.terminal import print_table

    rows = []
    for one in found:
        rows.append(
            [
                one.file,
                one.format,
                three_digits(one.bytes / 1e6),
                f"{one.gaussians:,}",
                f"{one.sh_degree}",
                one.up_text,
                "-" if one.fill is None else f"{one.fill:.1f}",
                f"{sum(one.suspicious.values()):,}",
            ]
        )
    header = ["file", "format", "MB", "Gaussians", "SH", "up", "fill", "suspicious"]
    print_table(header, rows, "fill: Gaussians drawn per pixel", left=(0, 1, 5))


def _print(found: SceneInfo) -> None:
    from pointsplat_ns.system.files import bytes_text

    say(f"{found.file}: {found.format}, {bytes_text(found.bytes)}")
    training = ", antialiased" if found.antialiased else ""
    say(f"{found.gaussians:,} Gaussians of SH degree {found.sh_degree}{training}")
    if found.offset:
        say(f"positions are relative to {' '.join(map(repr, found.offset))}")
    say(f"up: {found.up_text}{'; --up sets another axis' if found.up_is_guess else ''}")
    if found.fill is not None:
        say(f"fill: {found.fill:.1f} Gaussians drawn per pixel, in {found.views}")
    if found.sh_energies:
        root = ", ".join(
            f"degree {index + 1}: {value**0.5:.3g}" for index, value in enumerate(found.sh_energies)
        )
        say(f"SH contribution to colours, root mean square: {root}")
    for name, corners in (("all", found.bounds), ("middle 96 %", found.content)):
        if corners:
            low, high = (" ".join(f"{value:.4g}" for value in corner) for corner in corners)
            say(f"bounds, {name}: {low} to {high}, scene units")
    step = 1 / max(len(found.opacities), 1)
    _bars("opacity", {f"{index * step:.1f}": count for index, count in enumerate(found.opacities)})
    _bars("largest standard deviation, scene units, from", found.sizes)
    say(
        "suspicious: "
        + (
            ", ".join(f"{defect} {count:,}" for defect, count in found.suspicious.items())
            or "nothing"
        )
    )


def _bars(title: str, counts: dict[str, int]) -> None:
    say(f"{title}:")
    width = 40  # characters of the longest bar
    most = max([*counts.values(), 1])
    for name, count in counts.items():
        say(f"  {name:>6} {'#' * round(width * count / most):<{width}} {count:,}")
