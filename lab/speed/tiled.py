"""Writes a PLY of any number of Gaussians: copies of a real scene side by side.

    python -m lab.speed.tiled scenes/rock.ply big.ply --gaussians 50000000

Copies differ in their brightness, so that none is an exact copy of another. ``pointsplat prune big.ply --keep 10%
--memory 8GB`` then merges a scene larger than memory.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import tyro

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import read_scene
from pointsplat_ns.io.files import replacing
from pointsplat_ns.io.ply_writing import header_bytes, ply_bytes, row_table
from pointsplat_ns.looking.content import content_box


def main(scene: tyro.conf.Positional[Path], output: tyro.conf.Positional[Path], gaussians: int) -> None:
    """Write a PLY of copies of a scene.

    Args:
        scene: a scene of any format.
        output: the PLY to write.
        gaussians: number of Gaussians in it.
    """
    tile = read_scene(scene)
    low, high = content_box(tile)
    step = (high - low).to(tile.dtype)
    copies = -(-gaussians // len(tile))
    side = math.ceil(math.sqrt(copies))
    with replacing(output, ply_bytes(gaussians, tile.sh_degree)) as part, part.open("wb") as stream:
        stream.write(header_bytes(gaussians, tile.sh_degree))
        for number in range(copies):
            row_table(placed(tile, number, side, step)[: gaussians - number * len(tile)]).tofile(stream)


def placed(tile: Gaussians, number: int, side: int, step: torch.Tensor) -> Gaussians:
    """A copy of a scene, in its place of a square of ``side`` by ``side``, with a step (3,) along the longest axes."""
    place = torch.zeros(3)
    first, second = step.argsort(descending=True)[:2].tolist()
    place[first], place[second] = number % side, number // side
    brighter = 0.1 * math.sin(number)
    return tile.replace(means=tile.means + place * step, features_dc=tile.features_dc + brighter)


if __name__ == "__main__":
    tyro.cli(main)
