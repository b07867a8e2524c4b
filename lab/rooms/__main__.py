"""Draws synthetic rooms as data sets.

python -m lab.rooms -o rooms --seeds 0 1 --frames 40
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from lab.common.printing import start
from lab.rooms.write import is_written, write_room
from pointsplat_ns.errors import DataError


def main(
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    seeds: tuple[int, ...] = (0, 1, 2),
    frames: int = 80,
    width: int = 320,
    height: int = 240,
) -> None:
    """Draw furnished rooms with photos, depth images and poses, in the Replica layout.

    Existing rooms are kept, so the same command continues after an interruption.

    Args:
        output: folder for the scenes room0, room1..., named by their seeds.
        seeds: one room for each seed; the same seed gives the same room.
        frames: photos per room.
        width: width of a photo, pixels.
        height: height of a photo, pixels.
    """
    if not seeds:
        raise DataError(
            "--seeds without a value: expected the seed of each room, such as --seeds 0 1"
        )
    for seed in seeds:
        room = output / f"room{seed}"
        if is_written(room, frames, width, height):
            print(f"{room}: there already")
        else:
            print(write_room(room, seed, frames, width, height))


if __name__ == "__main__":
    start(main)
