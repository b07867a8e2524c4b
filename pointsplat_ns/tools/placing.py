"""Rotates, scales and moves scenes: to another up direction, unit of length, or frame of data."""

from __future__ import annotations

import math
import re
from pathlib import Path

import torch

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.geometry.transforms import axis_along, direction_of, smallest_turn
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.rotation import Similarity
from pointsplat_ns.scene.runs import RUN_FILES, Run, may_be_run, open_run
from pointsplat_ns.system.tensors import DOUBLES, FLOATS
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.upright import up_named


def place(
    scene: Gaussians,
    up: str | None = None,
    scale: float = 1.0,
    original_frame: str | Path | None = None,
) -> Gaussians:
    """Rotate and scale a scene, or move it back to the frame of its training data.

    nerfstudio rotates, centres and scales the poses of a dataset before training.
    ``original_frame`` undoes this, so that the scene fits poses, meshes and measurements of the
    data. It applies first, then ``up``, then ``scale``.

    Args:
        scene: N Gaussians.
        up: new up direction: "x", "y", "z", "-x", "-y" or "-z". The scene rotates about the origin.
            The old up direction is declared by the scene, estimated, or given: "-y:z" rotates -y to
            z. The result declares the new one.
        scale: factor on positions and sizes, above 0.
        original_frame: Splatfacto run of the scene (its folder, ``config.yml`` or checkpoint).

    Returns:
        N Gaussians on the same device.

    Raises:
        PointSplatError: if ``up`` is not an axis, or ``scale`` is not above 0.
        DataError: if up has to be estimated, and no Gaussian is visible.
        SceneError: if ``original_frame`` is not a run, or lacks its ``dataparser_transforms.json``.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::100]
        >>> turned = ps.place(room, up="z:y", scale=2.0)
        >>> bool((turned.means[:, 1] - 2 * room.means[:, 2]).abs().max() < 1e-5)
        True
    """
    if not 0 < scale < math.inf:
        raise PointSplatError(f"scale is {scale:g}; expected a number above 0")
    axes = "" if up is None else up.strip().lower()
    match = re.fullmatch(r"(?:([+-]?[xyz]):)?([+-]?[xyz])", axes)
    if up is not None and match is None:
        raise PointSplatError(
            f"up is {up!r}; expected an axis such as z or -y, or two such as -y:z (from -y to z)"
        )
    if original_frame is not None:
        scene = _frame_at(original_frame).inverse().apply(scene)
    if match is not None:
        now = up_named(match[1]) or Sampler(scene).up
        wanted = direction_of(match[2])
        turn = smallest_turn(now.direction, wanted)
        turned = Similarity(turn, 1.0, torch.zeros(3, **DOUBLES)).apply(scene)
        scene = turned.replace(up=axis_along(wanted))
    if scale != 1.0:
        scene = Similarity(torch.eye(3, **DOUBLES), scale, torch.zeros(3, **DOUBLES)).apply(scene)
    return scene


def _frame_at(path: str | Path) -> Similarity:
    run = open_run(path, need_data=False) if may_be_run(path) else None
    if run is None or not run.is_gaussian_scene:
        raise SceneError(
            f"{path}: not a Splatfacto run; expected the folder of a run, which stores the frame "
            "of its data"
        )
    transforms = run.folder / RUN_FILES.transforms
    if not transforms.is_file():
        raise SceneError(
            f"{transforms}: no such file, so the frame of the data is unknown; copy it from the "
            "original run (nerfstudio writes it when training starts), or leave the frame as it is"
        )
    return run_frame(run)


def run_frame(run: Run) -> Similarity:
    """The similarity from the frame of a run's data to the frame of its scene. Raises SceneError if
    the run's transform is not a rotation with one scale."""
    linear = run.transform[:, :3].double()
    size = float(torch.linalg.det(linear).abs()) ** (1 / 3)
    matrix = linear / size if size > 0 else linear
    off = (matrix @ matrix.T - torch.eye(3, **FLOATS)).abs().max()
    if not size > 0 or float(off) > 1e-4:  # saved with about 7 digits
        raise SceneError(
            f"{run.folder}: its transform is not a rotation with one scale; expected the file that "
            "nerfstudio saved"
        )
    u, _, v = torch.linalg.svd(matrix)
    return Similarity(u @ v, size * run.scale, run.transform[:, 3].double() * run.scale)
