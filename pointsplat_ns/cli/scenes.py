"""Subcommands that turn one scene into another: prune, export; and what compact shares with them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import tyro

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
OptionalOutput = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
Scene = tyro.conf.Positional[Path]
Method = Literal[
    "merge",
    "coverage",
    "paper",
    "authors",
    "opacity",
    "volume",
    "log-volume",
    "area",
    "random",
    "lightgaussian",
    "pup",
]
Bands = Literal["all", "auto", "0", "1", "2", "3"]


def say(what: str, dense: int, kept, seconds: float, path: Path | str) -> None:
    from pointsplat_ns.pruning import ply_bytes

    share = f" ({100 * len(kept) / dense:.1f} %)" if dense else ""
    size = ply_bytes(len(kept), kept.sh_degree) / 1e6
    print(f"{path}: {what} {len(kept):,} of {dense:,} Gaussians{share}, {size:.2f} MB, in {seconds:.1f} s")


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """A bar that is told what is being done and the share done of it; it leaves nothing behind."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks: dict[str, int] = {}

        def told(what: str, share: float) -> None:
            if what not in tasks:
                for task in tasks.values():
                    bar.update(task, visible=False)
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=share, visible=True)

        yield told


def show_distributions(dense, kept) -> None:
    """A table of what there was and what there is."""
    from rich.console import Console
    from rich.table import Table

    from pointsplat_ns.distributions import opacity_quantiles, size_quantiles
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
        table.add_row(name, text(dense), text(kept))
    Console().print(table)


def need_outputs(output: Path | None, picture: Path | None, dry_run: bool) -> None:
    """Refuse, before anything takes minutes, what could not be written in the end.

    Raises:
        SceneError: if ``output`` is missing without a dry run, or is no .ply, or ``picture`` no .png.
    """
    from pointsplat_ns.errors import SceneError

    if output is None and not dry_run:
        raise SceneError("--output is missing; expected the name of the .ply to write, or --dry-run")
    for path, kind in ((output, ".ply"), (picture, ".png")):
        if path is not None and path.suffix.lower() != kind:
            raise SceneError(
                f"{path}: cannot write a {path.suffix or 'nameless'} file; expected a name that ends in {kind}"
            )
        if path is not None and path.is_dir():
            raise SceneError(f"{path}: is a folder; expected the name of a file to write")


def write_unless_dry(scene, output: Path | None, dry_run: bool) -> Path | str:
    """Write a scene; says where it is."""
    from pointsplat_ns.io.scene import write_scene

    if output is None or dry_run:
        return "dry run, nothing is written"
    write_scene(scene, output)
    return output


def prune(
    scene: Scene,
    output: OptionalOutput = None,
    keep: str = "0.3",
    by: Method = "merge",
    opacity_weight: float = 0.3,
    sh: Bands = "all",
    fine_tune: int = 0,
    plot: Path | None = None,
    dry_run: bool = False,
) -> None:
    """Make a scene smaller: keep the Gaussians that matter, or merge them, from the scene alone.

    merge replaces neighbours by one Gaussian each and is by far the best; every other method keeps Gaussians as they
    are. coverage balances what a Gaussian contributes with what its neighbourhood would be left with; paper is eq. 3,
    authors the formula of its released code; lightgaussian and pup look at the scene from poses.

    Poses are those of the run's dataset where it is at hand; a bare .ply is looked at from free places within it.

    Args:
        scene: a 3DGS .ply, a Splatfacto checkpoint, or a Splatfacto run (its folder or config.yml).
        output: the .ply to write.
        keep: how much: a ratio (0.3), a percentage (30%), a count (50000), the size of the file (12MB), or auto:35, the
            smallest scene whose renders reach 35 dB PSNR against those of the dense scene (auto alone means 35).
        by: the method.
        opacity_weight: lambda of paper, authors and log-volume: the weight of opacity.
        sh: SH bands to keep: all, up to a degree, or auto, those without which renders stay within 40 dB.
        fine_tune: steps of optimising what was kept against the dense scene's own renders.
        plot: a .png to draw the distributions of opacity and volume in, before and after.
        dry_run: find and say everything, but write no scene.
    """
    from pointsplat_ns.compaction import Poses, compact_scene
    from pointsplat_ns.distributions import plot_distributions
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.io.scene import read_scene
    from pointsplat_ns.pruning import parse_keep

    need_outputs(output, plot, dry_run)
    if fine_tune < 0:
        raise SceneError(f"--fine-tune {fine_tune}: expected a number of steps, 0 for none")
    budget = parse_keep(keep)
    dense = read_scene(scene)
    start = time.perf_counter()
    with progress_bar() as told:
        made = compact_scene(dense, budget, by, sh, opacity_weight, Poses(scene, dense), fine_tune, progress=told)
    seconds = time.perf_counter() - start
    if plot is not None:
        plot_distributions({"before": dense, "after": made.scene}, plot)
    say("kept", len(dense), made.scene, seconds, write_unless_dry(made.scene, output, dry_run))
    for note in made.notes:
        print(note)
    show_distributions(dense, made.scene)
    if plot is not None:
        print(f"{plot}: opacity and volume, before and after")


def export(run: Scene, output: Output, scene: str | None = None) -> None:
    """Write the refined scene of a pointsplat run, or the trained one of a Splatfacto run, as a 3DGS .ply.

    Args:
        run: the run's folder, config.yml or checkpoint.
        output: the .ply to write.
        scene: which scene of a pointsplat run; by default the first that it was not trained on, or the first.
    """
    from pointsplat_ns.errors import SceneError
    from pointsplat_ns.io.runs import open_run
    from pointsplat_ns.io.scene import read_scene, write_scene
    from pointsplat_ns.refined_run import METHOD, open_refined_run

    start = time.perf_counter()
    try:
        method = open_run(run, need_data=False).method_name
    except SceneError:
        method = ""  # a scene that stands alone, or nothing that can be read: read_scene says which
    if method == METHOD:
        trained = open_refined_run(run)
        chosen = scene or trained.default_scene
        if chosen not in trained.scenes:
            raise SceneError(f"--scene {chosen}: no such scene in {run}; there are {', '.join(trained.scenes)}")
        dense = read_scene(trained.scenes[chosen])
        result, what = trained.compact(dense), f"{chosen}, refined:"
    else:
        if scene is not None:
            raise SceneError(f"--scene {scene}: {run} holds one scene; leave the option out")
        dense = result = read_scene(run)
        what = "wrote"
    write_scene(result, output)
    say(what, len(dense), result, time.perf_counter() - start, output)
