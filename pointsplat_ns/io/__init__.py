"""Readers and writers of Gaussian scenes, one file per format.

Every reader returns a :class:`~pointsplat_ns.gaussians.Gaussians` and raises
:class:`~pointsplat_ns.errors.SceneError` with one line that names the file and the fault.
"""

from pointsplat_ns.io.discovery import find_runs
from pointsplat_ns.io.files import content_hash
from pointsplat_ns.io.ply import read_ply, write_ply
from pointsplat_ns.io.runs import Run, open_run, scene_name
from pointsplat_ns.io.scene import read_scene, save
from pointsplat_ns.io.splatfacto import allow_splatfacto_checkpoints, read_checkpoint

__all__ = [
    "Run",
    "allow_splatfacto_checkpoints",
    "content_hash",
    "find_runs",
    "open_run",
    "read_checkpoint",
    "read_ply",
    "read_scene",
    "scene_name",
    "save",
    "write_ply",
]
