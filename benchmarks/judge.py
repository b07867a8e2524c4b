"""A judge that is not the defendant: scenes in views that were chosen by hand.

    python benchmarks/judge.py --sheet sheets scenes/rock.ply    # what the views of a scene's path show

A scene is a PLY file with a camera path of its name in ``benchmarks/paths``.
"""

from __future__ import annotations

from pathlib import Path

import tyro
from judge_paths import path_of, write_sheet

from pointsplat_ns.io import read_scene


def main(scenes: tyro.conf.Positional[tuple[Path, ...]], sheet: Path) -> None:
    """Draw the views of scenes.

    Args:
        scenes: PLY files, each with a path of its name in benchmarks/paths.
        sheet: a folder for one picture a scene, which shows all its views.
    """
    for scene in scenes:
        target = sheet / f"{scene.stem}.png"
        sheet.mkdir(parents=True, exist_ok=True)
        write_sheet(read_scene(scene), path_of(scene.stem), target)
        print(target, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
