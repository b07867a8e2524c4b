"""``pointsplat info``: figures of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.cli.printing import Json, print_json
from pointsplat_ns.cli.scene_options import Resolution, Scene, Up, check_output

if TYPE_CHECKING:
    from pointsplat_ns.compression.scene_info import SceneInfo


def info(
    scene: Scene,
    views: Path | None = None,
    resolution: Resolution = None,
    up: Up = None,
    force: bool = False,
    json_output: Json = False,
) -> None:
    """Look at a scene: counts, SH, opacities, sizes, bounds, rows that look wrong, and what files of it would weigh.

    Args:
        scene: a file of any format, a Splatfacto checkpoint, or a run (its folder or config.yml).
        views: a .png file for a sheet of the views that other commands use without --poses.
        resolution: size of these views, pixels. By default the size of the photos, if there are any, else 1920x1080.
        up: the axis that is up in the scene: x, y, z, -x, -y or -z, for views that are sampled; by default it is
            estimated. Write --up=-y for a negative axis.
        force: overwrite an existing file.
        json_output: print JSON, and nothing else on standard output.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.looking.windows import parse_resolution

    parse_resolution(resolution)
    check_output(views, ".png", force)
    found = ps.info(scene)
    sheet = None if views is None else ps.plot_views(scene, views, resolution=resolution, up=up)
    if json_output:
        print_json(found.as_dict())
        return
    _print(found)
    if sheet is not None:
        print(sheet)


def _print(found: SceneInfo) -> None:
    print(f"{found.gaussians:,} Gaussians of SH degree {found.sh_degree}")
    if found.sh_energies:
        root = ", ".join(f"degree {index + 1}: {value**0.5:.3g}" for index, value in enumerate(found.sh_energies))
        print(f"what SH add to colours, root mean square: {root}")
    for name, corners in (("all", found.bounds), ("middle 96 %", found.content)):
        if corners:
            low, high = (" ".join(f"{value:.4g}" for value in corner) for corner in corners)
            print(f"bounds, {name}: {low} to {high}, scene units")
    step = 1 / max(len(found.opacities), 1)
    _bars("opacity", {f"{index * step:.1f}": count for index, count in enumerate(found.opacities)})
    _bars("largest standard deviation, scene units, from", found.sizes)
    print("suspicious: " + (", ".join(f"{what} {n:,}" for what, n in found.suspicious.items()) or "nothing"))
    print("files, MB, if a share of the Gaussians is kept (.spz is estimated):")
    shares = next(iter(found.file_bytes.values()), {})
    print(" " * 18 + "".join(f"{share:>9}" for share in shares))
    for suffix, sizes in found.file_bytes.items():
        print(f"  {suffix:<16}" + "".join(f"{size / 1e6:>9.2f}" for size in sizes.values()))


def _bars(title: str, counts: dict[str, int]) -> None:
    print(f"{title}:")
    width = 40  # characters of the longest bar
    most = max([*counts.values(), 1])
    for name, count in counts.items():
        print(f"  {name:>6} {'#' * round(width * count / most):<{width}} {count:,}")
