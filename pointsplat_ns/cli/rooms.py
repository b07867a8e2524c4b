"""``pointsplat rooms``: generates synthetic rooms as data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from pointsplat_ns.cli.printing import Json, print_json


def rooms(
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    seeds: tuple[int, ...] = (0, 1, 2),
    frames: int = 80,
    width: int = 320,
    height: int = 240,
    json_output: Json = False,
) -> None:
    """Generate furnished rooms with photos, depth images and poses, in the Replica layout.

    Existing rooms are kept, so the same command continues after an interruption.

    Args:
        output: folder for the scenes room0, room1..., named by their seeds.
        seeds: one room for each seed; the same seed gives the same room.
        frames: photos per room.
        width: width of a photo, pixels.
        height: height of a photo, pixels.
        json_output: print the result as JSON, and nothing else on standard output.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.rooms.write import is_written

    if not seeds:
        raise ps.DataError("--seeds without a value: expected the seed of each room, such as --seeds 0 1")
    rooms = []
    for seed in seeds:
        room = output / f"room{seed}"
        there = is_written(room, frames, width, height)
        rooms.append(room if there else ps.write_room(room, seed, frames, width, height))
        if not json_output:
            print(f"{room}: there already" if there else room)
    if json_output:
        print_json({"output": output, "rooms": rooms})
