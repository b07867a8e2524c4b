"""The paper's tables on any scenes.

python -m lab.tables outputs/fox/splatfacto-cpu/RUN room.ply -o tables
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import tyro

from lab.common.printing import start
from lab.tables.measure import measure_tables
from pointsplat_ns.cli.scene_options import Share
from pointsplat_ns.io.files import logger
from pointsplat_ns.io.outputs import claimed_folder


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    keeps: tuple[Share, ...] = (0.5, 0.3, 0.1),
    refiners: tuple[Path, ...] = (),
    groups: tuple[str, ...] = (),
    only: tuple[str, ...] = (),
    views: int = 10,
    side: int = 640,
    scoring_views: int = 40,
    fine_tune: int = 300,
    splat_transform: str | None = None,
    data: Path | None = None,
    force: bool = False,
) -> None:
    """Measure the paper's Tables 1 to 4 and Figure 4 on any scenes, with our methods and splat-transform beside.

    Each cell, one scene made smaller in one way, is saved as soon as it is measured: after an interruption the same
    command goes on. The tables are of all scenes in the folder, also those of earlier commands.

    Args:
        scenes: Splatfacto runs (folders or config.yml), whose held-out photos are then used where they are found; or
            files of scenes.
        output: folder for the cells, tables.md, tables.tex, tables.json and figure4.png.
        keeps: shares of the Gaussians in Tables 1 and 2.
        refiners: weights for the rows with a network: runs or .safetensors files. Each row takes those with fitting
            metadata.
        groups: NAME=SCENE,SCENE...; means are taken over groups.
        only: names or patterns of cells, such as fox/merge/10%. Only these are measured, also if they were before.
        views: largest number of held-out views of a scene.
        side: largest side of all images, pixels; photos are reduced.
        scoring_views: largest number of training poses for the scores of LightGaussian and PUP-3DGS.
        fine_tune: steps of fine-tuning, against at most 60 training photos.
        splat_transform: path of the program; by default the one on PATH.
        data: folder above the data of the runs, or that of one, where it is no longer where the runs say; a run whose
            data is not found is measured without photos, with a warning.
        force: start over with the given scenes.
    """
    logging.basicConfig(format="%(message)s")
    logger.setLevel(logging.INFO)
    with claimed_folder(output):
        found = measure_tables(
            scenes, output, keeps=keeps, refiners=refiners, groups=groups, only=only, views=views, side=side,
            scoring_views=scoring_views, fine_tune=fine_tune, splat_transform=splat_transform, data=data, force=force,
            progress=True,
        )  # fmt: skip
    for group in found:
        cells = sum(len(scene.cells) for scene in group.scenes)
        print(f"{group.name}: {cells} cells of {', '.join(scene.about.name for scene in group.scenes)}")
    print(f"{output}: tables.md, tables.tex, tables.json and figure4.png")


if __name__ == "__main__":
    start(main)
