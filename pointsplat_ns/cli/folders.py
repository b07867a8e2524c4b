"""Commands on a folder of scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.cli.printing import print_json
from pointsplat_ns.system.terminal import print_table

if TYPE_CHECKING:
    from pointsplat_ns.scene_folder import SceneResult


def folder_command(
    run: Callable[..., list[SceneResult]],
    folder: Path,
    output: Path,
    refused: Mapping[str, object],
    json_output: bool,
    jobs: int | None,
    threads: int | None = None,
    **options: object,
) -> None:
    """Run a command on a folder, and print a table of its scenes, or JSON.

    Args:
        run: from both folders and options to the results: a function of :mod:`pointsplat_ns.folders`.
        folder: of scenes.
        output: folder of the results.
        refused: options that are for one scene only, by name; False and None stand for options not given.
        json_output: whether to print JSON.
        jobs: number of processes; by default 1.
        threads: number of threads of each; by default it adapts.
        options: all others of ``run``.

    Raises:
        SceneError: if an option is given that is for one scene only.
        PointSplatError: if a scene fails, after all the others.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.io.discovery import FOLDER_FILES
    from pointsplat_ns.system.threads import fixed_threads

    for name, given in refused.items():
        if given is not None and given is not False:
            raise ps.SceneError(f"{name} is for one scene; {folder} is a folder of scenes")
    with fixed_threads(threads):
        results = run(folder, output, jobs=1 if jobs is None else jobs, progress=True, **options)
    failed = sum(result.status == "failed" for result in results)
    if json_output:
        print_json({"output": output, "scenes": [asdict(result) for result in results]})
    else:
        _print_table(results)
        print(f"{output}: {len(results) - failed} of {len(results)} scenes, and the table {FOLDER_FILES.scenes_table}")
        for shown in filter(None, (options.get("html"), options.get("picture"))):
            print(f"{shown}: all scenes before and after")
    if failed:
        raise ps.PointSplatError(f"{failed} of {len(results)} scenes failed; the same command tries them again")


def _print_table(results: list[SceneResult]) -> None:
    forms = (",", ",", ".2f", ".1f", ".1f")
    rows = []
    for result in results:
        numbers = (result.before, result.after, result.megabytes, result.psnr, result.seconds)
        cells = ("-" if value is None else f"{value:{form}}" for value, form in zip(numbers, forms, strict=True))
        said = result.error or result.note
        rows.append((result.name, *cells, f"{result.status}: {said}" if said else result.status))
    header = ("scene", "before", "after", "MB", "dB", "seconds", "status")
    print_table(header, rows, "dB: PSNR against the scene's own renders", left=(0, 6))
