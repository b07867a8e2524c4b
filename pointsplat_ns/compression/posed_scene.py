"""Reads a scene together with views from a file of cameras, and checks that both have the same frame."""

from __future__ import annotations

from pathlib import Path

import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.io.camera_files import read_views, transforms_beside
from pointsplat_ns.io.runs import RUN_FILES
from pointsplat_ns.io.scene import read_scene
from pointsplat_ns.looking.poses import in_pictures
from pointsplat_ns.rasterizer.constants import ALPHA_MIN
from pointsplat_ns.views import Views


def read_posed(scene: Gaussians | Path | str, poses: Path | str) -> tuple[Gaussians, Views]:
    """Read a scene and its views. The file of cameras is read first; then both are checked against each other. Errors
    are those of :func:`views_for`, :func:`~pointsplat_ns.io.read_scene` and :func:`check_views_show`."""
    views = views_for(scene, poses)
    dense = scene if isinstance(scene, Gaussians) else read_scene(scene)
    views = views.relative_to(dense.offset)
    check_views_show(dense, views, poses)
    return dense, views


def views_for(scene: Gaussians | Path | str, poses: Path | str) -> Views:
    """Read the views of a scene from a file of cameras, of at most 1600 pixels on the longer side, as in 3DGS training.
    They are in the frame of the scene's file: :meth:`~pointsplat_ns.views.Views.relative_to` brings them to its offset.

    A ``dataparser_transforms.json`` in the scene's run, beside the scene or beside the poses moves them into the
    scene's frame. Raises SceneError if a file is missing, or the
    transforms are not usable, and DataError if the file has no usable cameras.
    """
    transforms = None if isinstance(scene, Gaussians) else _transforms_of(Path(scene))
    return read_views(poses, transforms).resized(1600)


def check_views_show(scene: Gaussians, views: Views, poses: Path | str) -> None:
    """Raise a DataError, with the path ``poses`` of the cameras, if fewer than half of the views show the scene.

    A view shows the scene if a visible Gaussian is in the picture, and the content is at least 2 % as wide as the
    picture: many a distant camera has a dot of the scene in its picture. The content leaves out 5 % of the Gaussians at
    each end of each axis, because far floaters are in the picture of nearly any camera. An even choice of up to 4096
    Gaussians and 256 cameras is checked. A scene without a visible Gaussian is not refused here.
    """
    visible = (scene.usable() & (scene.alphas >= ALPHA_MIN)).nonzero()[:, 0]
    means = scene.means[visible[:: max(1, len(visible) // 4096)]].double().cpu()
    if len(means) == 0:
        return
    low, high = (torch.quantile(means, share, dim=0, interpolation="nearest") for share in (0.05, 0.95))
    means = means[((means >= low) & (means <= high)).all(1)]
    checked = views.spread(256)
    distances = (invert_rigid(checked.viewmats.double())[:, :3, 3] - 0.5 * (low + high)).norm(dim=1)
    across = checked.Ks[:, 0, 0].double() * (high - low).norm()  # pixels, at a distance of 1
    large = (across >= 0.02 * checked.width * distances) | bool((low == high).all())
    showing = int((in_pictures(checked, means).any(1) & large).sum())
    if 2 * showing < len(checked):
        raise DataError(
            f"{poses}: {showing} of {len(checked)} cameras see anything of the scene; expected at least half; poses "
            "and scene are probably in different frames: nerfstudio moves and scales scenes, and its run says how in "
            "dataparser_transforms.json; put that file beside the scene"
        )


def _transforms_of(scene: Path) -> Path | None:
    """The ``dataparser_transforms.json`` of the scene's run, or beside its file."""
    folder = scene if scene.is_dir() else scene.parent
    if scene.suffix == ".ckpt" and not (folder / RUN_FILES.config).is_file():
        folder = folder.parent
    return transforms_beside(folder / RUN_FILES.config)
