"""A scene, and views of it from a file of cameras: read together, as the views must be in the scene's frame."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.cameras import invert_rigid
from pointsplat_ns.io.camera_files import read_views, transforms_beside
from pointsplat_ns.io.runs import CONFIG_NAME, may_be_run, open_run
from pointsplat_ns.io.scene import read_scene
from pointsplat_ns.rasterizer.constants import ALPHA_MIN
from pointsplat_ns.views import View, Views

LONGEST_SIDE = 1600
"""Maximum of the longer side of pictures, pixels. 3DGS training reduces photos to as much."""

_CHECKED_MEANS, _CHECKED_VIEWS = 4096, 256
"""Numbers of Gaussians and of cameras that are checked, evenly taken; a few hundredths of a second."""

_TAIL = 0.05
"""Share of the Gaussians, at each end of each axis, that do not count: far floaters stand in any camera's picture."""


_SMALLEST = 0.02
"""Least width of the scene's content that counts as seen, as a share of the picture's: from far enough away, many a
camera has a dot of it in the picture."""


def read_posed(scene: Gaussians | Path | str, poses: Path | str) -> tuple[Gaussians, Views]:
    """A scene, and the views of it that a file has. The file is read first, and both are checked against each other.

    Args:
        scene: N Gaussians, or where to read them.
        poses: as for :func:`views_for`.

    Raises:
        SceneError, DataError: as :func:`views_for`, :func:`~pointsplat_ns.io.read_scene` and :func:`need_seen`.
    """
    views = views_for(scene, poses)
    dense = scene if isinstance(scene, Gaussians) else read_scene(scene)
    need_seen(dense, views, poses)
    return dense, views


def views_for(scene: Gaussians | Path | str, poses: Path | str) -> Views:
    """The views of a scene that a file has.

    A ``dataparser_transforms.json`` in the scene's run, beside the scene or beside the poses moves them into the
    scene's frame. They are drawn as the scene's run was trained to be.

    Args:
        scene: N Gaussians, or where they are read from.
        poses: what :func:`~pointsplat_ns.io.camera_files.read_views` takes.

    Returns:
        C views of at most 1600 pixels on the longer side.

    Raises:
        SceneError: if a file is missing, or the transforms are not usable.
        DataError: if the file has no usable cameras.
    """
    if isinstance(scene, Gaussians):
        return read_views(poses).resized(LONGEST_SIDE)
    path = Path(scene)
    views = read_views(poses, _transforms_of(path)).resized(LONGEST_SIDE)
    if may_be_run(path):
        with suppress(SceneError):  # a checkpoint outside a run, or no scene; who reads it says which
            views = replace(views, rasterize_mode=open_run(path, need_data=False).rasterize_mode)
    return views


def need_seen(scene: Gaussians, views: Views, poses: Path | str) -> None:
    """Refuse views most of which see nothing of a scene.

    Args:
        scene: N Gaussians; a scene of which nothing is visible is not refused here.
        views: C cameras.
        poses: where they were read from, for the error.

    Raises:
        DataError: if fewer than half of them have a visible Gaussian in the picture, and the scene at a visible size.
    """
    visible = (scene.usable() & (scene.alphas >= ALPHA_MIN)).nonzero()[:, 0]
    means = scene.means[visible[:: max(1, len(visible) // _CHECKED_MEANS)]].double().cpu()
    if len(means) == 0:
        return
    low, high = (torch.quantile(means, share, dim=0, interpolation="nearest") for share in (_TAIL, 1 - _TAIL))
    means = means[((means >= low) & (means <= high)).all(1)]
    checked = views.spread(_CHECKED_VIEWS)
    away = (invert_rigid(checked.viewmats.double())[:, :3, 3] - 0.5 * (low + high)).norm(dim=1)
    across = checked.Ks[:, 0, 0].double() * (high - low).norm()  # pixels, at a distance of 1
    large = (across >= _SMALLEST * checked.width * away) | bool((low == high).all())
    seeing = sum(bool(_in_picture(means, view).any()) for view, shown in zip(checked, large, strict=True) if shown)
    if 2 * seeing < len(checked):
        raise DataError(
            f"{poses}: {seeing} of {len(checked)} cameras see anything of the scene; expected at least half; poses and "
            "scene are probably in different frames: nerfstudio moves and scales scenes, and its run says how in "
            "dataparser_transforms.json; put that file beside the scene"
        )


def _in_picture(means: Tensor, view: View) -> Tensor:
    """Whether positions (N, 3) are in front of a camera and in its picture, (N,) bool."""
    at = means @ view.viewmat[:3, :3].to(means).T + view.viewmat[:3, 3].to(means)
    x, y, w = (at @ view.K.to(means).T).unbind(1)
    # Multiplied by the depth, so that nothing is divided by it.
    return (w > 0) & (x >= 0) & (x <= view.width * w) & (y >= 0) & (y <= view.height * w)


def _transforms_of(scene: Path) -> Path | None:
    """The ``dataparser_transforms.json`` of the run that a scene is in, or beside its file."""
    folder = scene if scene.is_dir() else scene.parent
    if scene.suffix == ".ckpt" and not (folder / CONFIG_NAME).is_file():
        folder = folder.parent
    return transforms_beside(folder / CONFIG_NAME)
