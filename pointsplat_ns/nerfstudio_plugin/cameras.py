"""nerfstudio's cameras as views, and views as nerfstudio's cameras."""

from __future__ import annotations

import threading

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl, viewmats_to_opengl
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.views import EPS2D, NEAR_PLANE, RasterizeMode, Views


def cameras_of_views(views: Views) -> Cameras:
    """Views as nerfstudio cameras (C,), float32 on the CPU. Their poses are camera-to-world, in OpenGL axes.

    nerfstudio's cameras have no near plane and no ``eps2d``: these go into their metadata, where :func:`near_plane_of`
    and :func:`eps2d_of` find them. The background and the rasterize mode are not carried over.
    """
    poses, Ks = viewmats_to_opengl(views.viewmats.double().cpu()).float(), views.Ks.float().cpu()
    fx, fy, cx, cy = (Ks[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    carried = {"near_plane": views.near_plane, "eps2d": views.eps2d}
    metadata = {name: torch.full((len(views), 1), value, **DOUBLES) for name, value in carried.items()}
    kind = CameraType.PERSPECTIVE
    return Cameras(poses, fx, fy, cx, cy, views.width, views.height, camera_type=kind, metadata=metadata)


def near_plane_of(cameras: Cameras) -> float:
    """Near plane of cameras (C,), scene units; gsplat's if they do not come from :func:`cameras_of_views`. Raises
    DataError if they have several."""
    return _carried(cameras, "near_plane", NEAR_PLANE)


def eps2d_of(cameras: Cameras) -> float:
    """What cameras (C,) add to the diagonal of projected covariances, pixels^2; defaults and errors as of
    :func:`near_plane_of`."""
    return _carried(cameras, "eps2d", EPS2D)


def _carried(cameras: Cameras, name: str, default: float) -> float:
    values = (cameras.metadata or {}).get(name)
    if values is None or values.numel() == 0:
        return default
    different = values.unique().tolist()
    if len(different) != 1:
        raise DataError(f"cameras of {len(different)} values of {name}; expected one for all views")
    return different[0]


def need_pinhole(camera: Cameras) -> None:
    """Raise a DataError if a camera (1,) has a lens: a pinhole's picture is not what it sees.

    Datasets have none (:mod:`~pointsplat_ns.nerfstudio_plugin.undistorted`); camera paths of the viewer may. The viewer
    itself draws in a thread, which an error would end: there such a camera is previewed as a pinhole, as nerfstudio's
    Splatfacto does.
    """
    kind = CameraType(int(camera.camera_type))
    if kind != CameraType.PERSPECTIVE and threading.current_thread() is threading.main_thread():
        raise DataError(
            f"cameras of kind {kind.name.lower()}: expected perspective ones; choose Perspective in the render tab of "
            "the viewer, or change camera_type in the camera path"
        )


def views_of_cameras(cameras: Cameras, background: Tensor, rasterize_mode: RasterizeMode = "classic") -> Views:
    """nerfstudio cameras (C,) as pinhole views on their device. Lens distortion is ignored. Raises DataError if the
    cameras have images of several sizes, or differ in near plane or ``eps2d``."""
    sizes = {(int(w), int(h)) for w, h in zip(cameras.width, cameras.height, strict=True)}
    if len(sizes) != 1:
        raise DataError(f"photos of {len(sizes)} sizes; expected one size for all views")
    ((width, height),) = sizes
    viewmats = viewmats_from_opengl(cameras.camera_to_worlds)
    carried = near_plane_of(cameras), eps2d_of(cameras)
    return Views(viewmats, cameras.get_intrinsics_matrices(), width, height, background, rasterize_mode, *carried)
