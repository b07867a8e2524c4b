"""Built-in synthetic rooms: procedural, furnished, lit, with highlights that move with the
viewer."""

from lab.rooms.render import default_intrinsics, render_room
from lab.rooms.room import Room, make_room
from lab.rooms.write import capture_path, write_room

__all__ = ["Room", "capture_path", "default_intrinsics", "make_room", "render_room", "write_room"]
