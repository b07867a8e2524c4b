"""Recognises moving scenes. Their files hold all moments at once, or one to be deformed, so that
they are no scene to draw.

Sources: the PLY attributes and files that the trainers named below write.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from pointsplat_ns.errors import SceneError

_ONE_MOMENT = "export a PLY of one moment from the program that trained it"

_PARAMETERS = (
    ("SpacetimeGaussians", r"trbf_(center|scale)"),
    ("4D Gaussian Splatting", r"(scale|scaling)_t(_\d+)?|rot(ation)?_r(_\d+)?"),
    ("Ex4DGS", r"xyz_disp(_\d+)?"),
    ("a 4D training", r"(motion|omega|velocity)_\d+|omega|motion|velocities|durations?|means_t"),
)
"""Trainers of moving scenes, and the names of parameters of which one tells them."""


class _Companion(NamedTuple):
    trainer: str
    file: str
    """Path of a file that belongs to ``point_cloud.ply``, from its folder."""
    instead: str


_COMPANIONS = (
    _Companion(
        "4DGaussians",
        "deformation.pth",
        "write a PLY of each moment with its export_perframe_3DGS.py",
    ),
    _Companion("Ex4DGS", "dynamic_point_cloud.ply", _ONE_MOMENT),
    _Companion(
        "Deformable 3D Gaussians or a relative", "../../deform/{folder}/deform.pth", _ONE_MOMENT
    ),
)


def refuse_moving(names: Iterable[str], path: Path) -> None:
    """Raise SceneError if parameters or PLY properties of these names make a scene move."""
    names = tuple(names)
    for trainer, pattern in _PARAMETERS:
        found = next((name for name in names if re.fullmatch(pattern, name)), None)
        if found is not None:
            raise SceneError(
                f"{path}: a moving scene of {trainer} ({found!r}), with all its moments at once; "
                f"{_ONE_MOMENT}"
            )


def refuse_deformed(path: Path) -> None:
    """Raise SceneError if the files beside a trainer's ``point_cloud.ply`` make it move."""
    if path.name != "point_cloud.ply":
        return
    folder = path.absolute().parent
    for companion in _COMPANIONS:
        file = folder / companion.file.format(folder=folder.name)
        if file.is_file():
            raise SceneError(
                f"{path}: a moving scene of {companion.trainer}, which {file.name} deforms; "
                f"{companion.instead}"
            )
