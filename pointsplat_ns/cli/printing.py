"""Prints results of commands, as text or as JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from dataclasses import asdict
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from pointsplat_ns.system.quantities import seconds_text
from pointsplat_ns.system.terminal import say

if TYPE_CHECKING:
    from pointsplat_ns.pipeline.quality import Quality
    from pointsplat_ns.scene.gaussians import Gaussians
    from pointsplat_ns.scene.ply import PlyRows
    from pointsplat_ns.tools.folders import SceneResult

_OUTPUT: ContextVar[IO[str] | None] = ContextVar("output", default=None)


@contextmanager
def only_json(args: list[str]) -> Iterator[None]:
    """With ``--json`` in the arguments, reserve standard output for :func:`print_json` in this
    context. All other output, including that of libraries, goes to standard error."""
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
    from pointsplat_ns.system.files import json_text

    print(json_text(content), file=_OUTPUT.get(), flush=True)


def scene_result(
    before: int | None, scene: Gaussians | PlyRows, seconds: float, where: Path
) -> dict[str, Any]:
    """JSON values of a result. ``before`` is the count of the dense scene; None if there is
    none."""
    version = _spz_version(where)
    return {
        "output": where,
        **({} if before is None else {"gaussians_before": before}),
        "gaussians": len(scene),
        "sh_degree": scene.sh_degree,
        "bytes": where.stat().st_size,
        **({} if version is None else {"spz_version": version}),
        "seconds": seconds,
    }


def print_result(
    by: str,
    also: list[str],
    before: int,
    scene: Gaussians | PlyRows,
    seconds: float,
    where: Path,
    quality: Quality | None,
    in_parts: bool = False,
) -> None:
    """Print stages (the method, and ``also`` refined, repaired), counts, file size, duration, and
    quality against the dense scene and fill, or the reason why they are unknown. A scene merged
    ``in_parts`` does not fit into memory."""
    from pointsplat_ns.tools.wording import fill_text, quality_text

    *first, last = [{"merge": "merged", "clean": "cleaned"}.get(by, f"pruned by {by}"), *also]
    done = f"{', '.join(first)} and {last}" if first else last
    summary = (
        f"{done} to {len(scene):,} of {before:,} Gaussians ({100 * len(scene) / before:.3g} %)"
    )
    if len(scene) == before and not also:
        verb = {"merge": "merged", "clean": "removed"}.get(by, "pruned")
        summary = f"nothing is {verb}, all {before:,} Gaussians remain"
    say(f"{where}: {summary}, {written_size(where)}, in {seconds_text(seconds)}")
    print_readers(where)
    if quality is not None:
        say(quality_text(quality))
        say(fill_text(quality))
    elif in_parts:
        say("not compared with the dense scene: it does not fit into memory")
    else:
        say("not compared with the dense scene: nothing of it is visible")


def print_readers(where: Path) -> None:
    """Print the version of an SPZ file, and the programs that read it. Other files print
    nothing."""
    from pointsplat_ns.tools.wording import spz_readers

    version = _spz_version(where)
    if version is not None:
        say(spz_readers(version))


def _spz_version(where: Path) -> int | None:
    """Version of a written SPZ file; None for other formats."""
    from pointsplat_ns.scene.formats.spz import version_of

    return version_of(where) if where.suffix.lower() == ".spz" else None


def print_if_larger(scene: Path, where: Path) -> None:
    """Print a note if the result is larger than the scene's file, which has a more compact
    format."""
    if scene.is_file() and scene.suffix != ".yml" and scene.stat().st_size < where.stat().st_size:
        same_format = scene.suffix == where.suffix
        remedy = "" if same_format else f"; a name that ends in {scene.suffix} makes it smaller"
        say(
            f"note: {where} is larger than {scene}: {written_size(where)}, not "
            f"{written_size(scene)}{remedy}"
        )


def psnr_text(psnr: float | None) -> str:
    """A PSNR in a table, dB: ``same`` for equal renders, a dash if not compared."""
    from pointsplat_ns.tools.wording import BEST_PSNR

    return "-" if psnr is None else "same" if psnr == math.inf else f"{min(psnr, BEST_PSNR):.1f}"


def written_size(where: Path) -> str:
    """Size of a file as text."""
    from pointsplat_ns.system.files import bytes_text

    return bytes_text(where.stat().st_size)


def print_folder(
    results: list[SceneResult],
    folder: Path,
    shown: list[Path],
    json_output: bool,
    compared: bool = True,
) -> None:
    """Print the results of a folder as a table, or as JSON. Raises PointSplatError if a scene
    failed.

    Args:
        results: of all scenes.
        folder: folder of the results.
        shown: files with pictures of all scenes.
        json_output: whether to print JSON.
        compared: whether results are compared with their scenes, in dB.
    """
    from pointsplat_ns.errors import PointSplatError
    from pointsplat_ns.scene.discovery import FOLDER_FILES
    from pointsplat_ns.system.terminal import print_table

    failed = sum(result.status == "failed" for result in results)
    if json_output:
        print_json({"output": folder, "scenes": [asdict(result) for result in results]})
    else:
        columns = {"before": ",", "after": ",", "megabytes": ".2f", "psnr": ".1f"}
        titles = {"megabytes": "MB", "psnr": "dB"}
        if not compared:
            columns = {"after": ",", "megabytes_before": ".2f", "megabytes": ".2f"}
            titles = {"after": "Gaussians", "megabytes_before": "MB before", "megabytes": "MB"}
        columns["seconds"] = ".1f"
        rows = []
        for result in results:
            numbers = [getattr(result, name) for name in columns]
            cells = (
                "-" if value is None else f"{value:{form}}"
                for value, form in zip(numbers, columns.values(), strict=True)
            )
            remark = result.error or result.note
            status = f"{result.status}: {remark}" if remark else result.status
            rows.append((result.name, *cells, status))
        header = ("scene", *(titles.get(name, name) for name in columns), "status")
        note = "dB: PSNR against the scene's own renders" if compared else ""
        print_table(header, rows, note, left=(0, len(header) - 1))
        done = [result.output for result in results if result.status in ("done", "done before")]
        spz = next((file for file in map(Path, done) if file.suffix == ".spz"), None)
        if spz is not None:
            print_readers(spz)
        say(
            f"{folder}: {len(results) - failed} of {len(results)} scenes, and the table "
            f"{FOLDER_FILES.scenes_table}"
        )
        for path in shown:
            say(f"{path}: all scenes before and after")
    if failed:
        raise PointSplatError(
            f"{failed} of {len(results)} scenes failed; run the same command to retry them"
        )
