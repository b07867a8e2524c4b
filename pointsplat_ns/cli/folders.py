"""``pointsplat compact`` on a folder of scenes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.cli.printing import print_json
from pointsplat_ns.system.terminal import print_table

if TYPE_CHECKING:
    from pointsplat_ns.compression.scene_task import SceneResult


def compact_folder(
    folder: Path,
    output: Path | None,
    poses: Path | None,
    up: str | None,
    picture: Path | None,
    html: Path | None,
    dry_run: bool,
    json_output: bool,
    **options,
) -> None:
    """Compact every scene of a folder, with further options of :func:`pointsplat_ns.compact_folder`, and print a table
    of them, or JSON. Raises SceneError if an option is given that is for one scene only, and PointSplatError if a scene
    fails, after all the others."""
    import pointsplat_ns as ps
    from pointsplat_ns.compression.scene_folder import TABLE_NAME, output_folder
    from pointsplat_ns.system.processes import torchrun_rank

    refused = {"--poses": poses, "--up": up, "--picture": picture, "--html": html, "--dry-run": dry_run or None}
    for name, given in refused.items():
        if given is not None:
            raise ps.SceneError(f"{name} is for one scene; {folder} is a folder of scenes")
    target = output or output_folder(folder, "compact")
    results = ps.compact_folder(folder, target, progress=True, **options)
    if torchrun_rank()[0] > 0:
        return  # the first process speaks for all
    failed = sum(result.status == "failed" for result in results)
    if json_output:
        print_json({"output": target, "scenes": [asdict(result) for result in results]})
    else:
        _print_table(results)
        print(f"{target}: {len(results) - failed} of {len(results)} scenes, and the table {TABLE_NAME}")
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
