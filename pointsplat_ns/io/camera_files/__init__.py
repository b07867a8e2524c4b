"""Readers of files of cameras, one module per format: poses and intrinsics that others wrote, as views.

Every file may come from a stranger: it is read within limits, and refused in one line.
"""

from pointsplat_ns.io.camera_files.registry import (
    CAMERA_KINDS,
    NamedViews,
    camera_files_near,
    is_camera_file,
    read_named_views,
    read_views,
    transforms_beside,
)

__all__ = [
    "CAMERA_KINDS",
    "NamedViews",
    "camera_files_near",
    "is_camera_file",
    "read_named_views",
    "read_views",
    "transforms_beside",
]
