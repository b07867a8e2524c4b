"""Reads and writes scenes of all supported formats."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import require_file
from pointsplat_ns.io.ply import read_ply, write_ply
from pointsplat_ns.io.runs import CONFIG_NAME, open_run
from pointsplat_ns.io.splatfacto import read_checkpoint

ACCEPTED = "a 3DGS .ply, a Splatfacto .ckpt, or a Splatfacto run (its folder or config.yml)"

SCENE_SUFFIXES = (".ply", ".ckpt")
"""Suffixes of files that hold a whole scene."""


def is_scene_file(path: Path | str) -> bool:
    """Whether :func:`read_scene` takes a file for a scene, by its suffix. A run is told by its folder instead."""
    return Path(path).suffix.lower() in SCENE_SUFFIXES


def read_scene(path: Path | str) -> Gaussians:
    """Read a scene: a 3DGS PLY, a Splatfacto checkpoint, or the newest checkpoint of a Splatfacto run.

    Args:
        path: a ``.ply``, a ``.ckpt``, a ``config.yml`` or a run's folder. The photos of a run are not needed.

    Returns:
        The scene, float32 on the CPU. Log-scales and logits are those of the file.

    Raises:
        SceneError: if the path is none of these, or the file is damaged.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(Gaussians.empty(sh_degree=2), f"{folder}/nothing.ply")
        ...     read_scene(f"{folder}/nothing.ply").sh_degree
        2
    """
    path = Path(path)
    if path.is_dir():
        if not (path / CONFIG_NAME).is_file():
            raise SceneError(f"{path}: a folder without {CONFIG_NAME}; expected {ACCEPTED}")
        return read_checkpoint(open_run(path, need_data=False).checkpoint)
    require_file(path, ACCEPTED)
    kind = path.suffix.lower()
    if kind == ".ply":
        return read_ply(path)
    if kind == ".ckpt":
        return read_checkpoint(path)
    if kind in (".yml", ".yaml"):
        return read_checkpoint(open_run(path, need_data=False).checkpoint)
    raise SceneError(f"{path}: a {kind or 'nameless'} file; expected {ACCEPTED}")


def save(scene: Gaussians, path: Path | str) -> None:
    """Write a scene as a 3DGS PLY, which viewers of Gaussian scenes and :func:`pointsplat_ns.load` read.

    A float32 scene is read back unchanged to the bit. Gaussians that cannot be drawn (NaN, or Inf where it is not
    valid) are left out, and their number is logged. The write is atomic and replaces an existing file.

    Args:
        scene: N Gaussians of SH degree d, on any device and of any floating dtype. Each takes 68 + 12 K bytes as
            float32, with K = (d+1)^2 - 1 and 12 bytes of unused normals.
        path: a path that ends in ``.ply``. Missing folders are created.

    Raises:
        SceneError: if the path has another suffix, is a folder, or cannot be written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[:100], f"{folder}/small.ply")
        ...     len(ps.load(f"{folder}/small.ply"))
        100
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise SceneError(f"{path}: cannot write a {path.suffix or 'nameless'} file; expected a name that ends in .ply")
    write_ply(scene, path)
