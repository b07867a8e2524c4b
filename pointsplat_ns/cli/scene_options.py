"""What commands that turn one scene into another have in common: arguments, where the result goes, what is said."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from pointsplat_ns.gaussians import Gaussians

Scene = tyro.conf.Positional[Path]
Output = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
Bands = Literal["all", "auto", "0", "1", "2", "3"]


def output_beside(scene: Path, suffix: str) -> Path:
    """The name of the result where the user gives none: beside the file, ``room.ply`` to ``room_pruned.ply``; in the
    folder of a run, whose checkpoint folder nerfstudio wants to itself."""
    if scene.is_dir():
        return scene / f"{suffix}.ply"
    if scene.parent.name == "nerfstudio_models":
        return scene.parent.parent / f"{suffix}.ply"
    if scene.suffix.lower() in (".yml", ".yaml"):
        return scene.with_name(f"{suffix}.ply")
    return scene.with_name(f"{scene.stem}_{suffix}.ply")


def check_outputs(scene: Path, force: bool, picture: Path | None = None) -> None:
    """Refuse, before anything takes minutes, what could not be written in the end.

    Raises:
        SceneError: if ``scene`` is no .ply, is there already without ``force``, or ``picture`` is no .png.
    """
    from pointsplat_ns.errors import SceneError

    for path, kind in ((scene, ".ply"), (picture, ".png")):
        if path is not None and path.suffix.lower() != kind:
            raise SceneError(
                f"{path}: cannot write a {path.suffix or 'nameless'} file; expected a name that ends in {kind}"
            )
        if path is not None and path.is_dir():
            raise SceneError(f"{path}: is a folder; expected the name of a file to write")
    if scene.exists() and not force:
        raise SceneError(f"{scene}: is there already; name another with -o, or overwrite it with --force")


def say_written(what: str, before: int, scene: Gaussians, seconds: float, where: Path | None) -> None:
    """One line on the result; ``where`` is None in a dry run."""
    from pointsplat_ns.pruning import ply_bytes

    share = f" ({100 * len(scene) / before:.1f} %)" if before else ""
    size = ply_bytes(len(scene), scene.sh_degree) / 1e6
    place = "dry run, nothing is written" if where is None else where
    print(f"{place}: {what} {len(scene):,} of {before:,} Gaussians{share}, {size:.2f} MB, in {seconds:.1f} s")


def show_distributions(before: Gaussians, after: Gaussians) -> None:
    """A table of what there was and what there is."""
    from rich.console import Console
    from rich.table import Table

    from pointsplat_ns.compression.distributions import opacity_quantiles, size_quantiles
    from pointsplat_ns.pruning import ply_bytes

    table = Table("", "before", "after", caption="quantiles are 10 / 50 / 90 %; size is the largest standard deviation")
    rows = {
        "Gaussians": lambda s: f"{len(s):,}",
        "SH degree": lambda s: f"{s.sh_degree}",
        "file, MB": lambda s: f"{ply_bytes(len(s), s.sh_degree) / 1e6:.2f}",
        "opacity": lambda s: " / ".join(f"{value:.2f}" for value in opacity_quantiles(s)),
        "size, scene units": lambda s: " / ".join(f"{value:.2g}" for value in size_quantiles(s)),
    }
    for name, text in rows.items():
        table.add_row(name, text(before), text(after))
    Console().print(table)
