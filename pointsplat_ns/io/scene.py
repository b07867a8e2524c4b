"""One way in and one way out for a scene, whatever its format."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import require_file
from pointsplat_ns.io.ply import read_ply, write_ply
from pointsplat_ns.io.runs import CONFIG_NAME, open_run
from pointsplat_ns.io.splatfacto import read_checkpoint

ACCEPTED = "a 3DGS .ply, a Splatfacto .ckpt, or a Splatfacto run (its folder or config.yml)"


def read_scene(path: Path | str) -> Gaussians:
    """Read a scene: a 3DGS PLY, a Splatfacto checkpoint, or the newest checkpoint of a Splatfacto run.

    Args:
        path: a ``.ply``, a ``.ckpt``, a ``config.yml`` or a run's folder. The photos of a run are not needed.

    Returns:
        The scene, float32 on the CPU.

    Raises:
        SceneError: if it is none of these, or damaged.
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
    """Write a scene in the format that the name asks for; today a 3DGS PLY.

    Raises:
        SceneError: if the name asks for another format or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise SceneError(f"{path}: cannot write a {path.suffix or 'nameless'} file; expected a name that ends in .ply")
    write_ply(scene, path)
