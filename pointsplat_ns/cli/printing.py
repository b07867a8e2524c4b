"""Prints results of commands, as text or as JSON."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import tyro

from pointsplat_ns.cli.scene_options import file_bytes

if TYPE_CHECKING:
    from pointsplat_ns.gaussians import Gaussians

Json = Annotated[bool, tyro.conf.arg(name="json")]

_OUTPUT: ContextVar[IO[str] | None] = ContextVar("output", default=None)


@contextmanager
def only_json(args: list[str]) -> Iterator[None]:
    """With ``--json`` in the arguments, only :func:`print_json` writes to standard output in this context. All other
    output, also of libraries, goes to standard error."""
    if "--json" not in args:
        yield
        return
    token = _OUTPUT.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _OUTPUT.reset(token)


def print_json(content: Any) -> None:
    """Print a result as JSON."""
    from pointsplat_ns.io.files import json_text

    print(json_text(content), file=_OUTPUT.get(), flush=True)


def end_if_interrupted(interrupted: bool) -> None:
    """End a command as Ctrl-C does, once the best result so far is written and printed.

    Args:
        interrupted: whether Ctrl-C ended the work early.

    Raises:
        KeyboardInterrupt: if so.
    """
    if interrupted:
        raise KeyboardInterrupt


def scene_result(before: int | None, scene: Gaussians, seconds: float, where: Path | None) -> dict[str, Any]:
    """The JSON values of a result.

    Args:
        before: number of Gaussians in the dense scene; None if there is no such scene.
        scene: the resulting scene.
        seconds: duration.
        where: the written file; None in a dry run, whose ``bytes`` are those of a PLY.
    """
    from pointsplat_ns.pruning import ply_bytes

    return {
        "output": where,
        **({} if before is None else {"gaussians_before": before}),
        "gaussians": len(scene),
        "sh_degree": scene.sh_degree,
        "bytes": ply_bytes(len(scene), scene.sh_degree) if where is None else file_bytes(where),
        "seconds": seconds,
    }


def print_result(what: str, before: int, scene: Gaussians, seconds: float, where: Path | None) -> None:
    """Print one line with counts, file size (that of a PLY in a dry run) and time; ``where`` is None in a dry run."""
    from pointsplat_ns.pruning import ply_bytes

    share = f" ({100 * len(scene) / before:.1f} %)" if before else ""
    size = (ply_bytes(len(scene), scene.sh_degree) if where is None else file_bytes(where)) / 1e6
    place = "dry run, nothing is written" if where is None else where
    print(f"{place}: {what} {len(scene):,} of {before:,} Gaussians{share}, {size:.2f} MB, in {seconds:.1f} s")


def print_distributions(before: Gaussians, after: Gaussians) -> None:
    """Print a table of counts, file sizes and quantiles, before and after."""
    from rich.console import Console
    from rich.table import Table

    from pointsplat_ns.compression.distributions import opacity_quantiles, size_quantiles
    from pointsplat_ns.pruning import ply_bytes

    table = Table("", "before", "after", caption="quantiles are 10 / 50 / 90 %; size is the largest standard deviation")
    rows = {
        "Gaussians": lambda s: f"{len(s):,}",
        "SH degree": lambda s: f"{s.sh_degree}",
        "as .ply, MB": lambda s: f"{ply_bytes(len(s), s.sh_degree) / 1e6:.2f}",
        "opacity": lambda s: " / ".join(f"{value:.2f}" for value in opacity_quantiles(s)),
        "size, scene units": lambda s: " / ".join(f"{value:.2g}" for value in size_quantiles(s)),
    }
    for name, text in rows.items():
        table.add_row(name, text(before), text(after))
    Console().print(table)
