"""The files that scenes are exchanged in, beside the plain PLY: one module for each, and a registry of all.

All of them keep numbers in few bits. ``docs/formats.md`` says what each loses. Readers check counts and sizes
against the size of the file before memory is taken, and bound what is decompressed.
"""

from pointsplat_ns.io.formats.registry import (
    FORMATS,
    READABLE,
    WRITABLE,
    Format,
    format_like,
    format_named,
    format_to_read,
    format_to_write,
)
from pointsplat_ns.io.formats.sog_images import META as SOG_META
from pointsplat_ns.io.formats.sog_stream import STREAM_META, coarser_levels

__all__ = [
    "FORMATS",
    "READABLE",
    "SOG_META",
    "STREAM_META",
    "WRITABLE",
    "Format",
    "coarser_levels",
    "format_like",
    "format_named",
    "format_to_read",
    "format_to_write",
]
