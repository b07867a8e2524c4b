"""A synthetic room: its description, and its textures and light."""

from dataclasses import dataclass
from functools import cached_property

from pointsplat_ns.errors import DataError
from pointsplat_ns.rooms.building import RoomSpec
from pointsplat_ns.rooms.layout import sample_room
from pointsplat_ns.rooms.light import BakedRoom, bake


@dataclass(frozen=True)
class Room:
    """A synthetic room; its textures and light are computed when it is first rendered.

    Attributes:
        spec: its kind, size, solids, materials and lights.
    """

    spec: RoomSpec

    @cached_property
    def baked(self) -> BakedRoom:
        """Textures and light; computing them takes a second or two."""
        return bake(self.spec)


def make_room(seed: int) -> Room:
    """The room of a seed: its kind, size, furniture, materials and lights.

    Args:
        seed: 0 or more; the same seed gives the same room.

    Raises:
        DataError: if the seed is negative.

    Example:
        >>> make_room(3).spec.kind
        'dining'
    """
    if seed < 0:
        raise DataError(f"room seed {seed}: expected 0 or more")
    return Room(sample_room(seed))
