"""nerfstudio's cameras as views, and views as nerfstudio's cameras."""

from __future__ import annotations

from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.cameras import viewmats_from_opengl, viewmats_to_opengl
from pointsplat_ns.views import RasterizeMode, Views


def cameras_of_views(views: Views) -> Cameras:
    """Views as nerfstudio cameras (C,), float32 on the CPU. Their poses are camera-to-world, in OpenGL axes."""
    poses, Ks = viewmats_to_opengl(views.viewmats.double().cpu()).float(), views.Ks.float().cpu()
    fx, fy, cx, cy = (Ks[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Cameras(poses, fx, fy, cx, cy, views.width, views.height, camera_type=CameraType.PERSPECTIVE)


def views_of_cameras(cameras: Cameras, background: Tensor, rasterize_mode: RasterizeMode = "classic") -> Views:
    """nerfstudio cameras (C,) as pinhole views on their device. Lens distortion is ignored.

    Raises:
        DataError: if the cameras have images of several sizes.
    """
    sizes = {(int(w), int(h)) for w, h in zip(cameras.width, cameras.height, strict=True)}
    if len(sizes) != 1:
        raise DataError(f"photos of {len(sizes)} sizes; expected one size for all views")
    ((width, height),) = sizes
    viewmats = viewmats_from_opengl(cameras.camera_to_worlds)
    return Views(viewmats, cameras.get_intrinsics_matrices(), width, height, background, rasterize_mode)
