"""nerfstudio's cameras as views, views as nerfstudio's cameras, and the options of the rasterizer
in both models."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Literal

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl, viewmats_to_opengl
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.rendering.rasterize import use_gsplat
from pointsplat_ns.scene.views import EPS2D, NEAR_PLANE, ImageSize, RasterizeMode, Views
from pointsplat_ns.system.kernels import KERNELS
from pointsplat_ns.system.tensors import DOUBLES, INDICES

VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""Evaluation background of scenes trained with random backgrounds: the viewer's colour, as in
Splatfacto."""


@dataclass
class RasterizerOptions:
    """Choice of the rasterizer and its speed"""

    backend: Literal["auto", "torch", "gsplat"] = "auto"
    """Rasterizer: torch runs everywhere, gsplat needs CUDA, auto takes gsplat if its CUDA kernels
    are available."""
    compiled: bool | None = None
    """Draw with compiled kernels on a CPU: None if they were built, True warns if they were not,
    False leaves it to torch, which is several times slower."""
    quality: Literal["exact", "balanced", "fast"] = "exact"
    """Accuracy that training gives up for speed (see docs/rasterizer.md). Evaluation is always
    exact."""

    def engine(self, device: torch.device) -> str:
        """Name of the rasterizer in use, a line for the log."""
        if self.backend != "torch" and use_gsplat(self.backend, device):
            return "rasterizer: gsplat"
        if device.type != "cpu":
            return "rasterizer: torch"
        why = (
            "as --pipeline.model.compiled is False"
            if self.compiled is False
            else KERNELS.why_missing
        )
        slow = f"torch, several times slower than compiled kernels: {why}"
        return f"rasterizer: {slow if why else 'compiled'}"

    def rasterize(self, training: bool, **arguments) -> tuple[Tensor, Tensor, dict]:
        """:func:`~pointsplat_ns.rendering.rasterize` with these options; exact outside of
        training."""
        quality = self.quality if training else "exact"
        return rasterization(
            **arguments, backend=self.backend, compiled=self.compiled, quality=quality
        )


def cameras_of_views(views: Views) -> Cameras:
    """Views as nerfstudio cameras (C,), float32 on the CPU, without background and rasterize mode.
    nerfstudio's cameras have no near plane and no ``eps2d``: these go into their metadata, where
    :func:`carried` finds them."""
    poses = viewmats_to_opengl(views.viewmats.double().cpu()).float()
    Ks = views.Ks.float().cpu()
    fx, fy, cx, cy = (Ks[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    eps2d = [size.eps2d for size in views.size_of_each()]
    metadata = {
        "near_plane": torch.full((len(views), 1), views.near_plane, **DOUBLES),
        "eps2d": torch.tensor(eps2d, **DOUBLES)[:, None],
    }
    sizes = torch.tensor([size[:2] for size in views.size_of_each()], **INDICES).view(-1, 2)
    width, height = sizes.split(1, dim=1)
    kind = CameraType.PERSPECTIVE
    return Cameras(poses, fx, fy, cx, cy, width, height, camera_type=kind, metadata=metadata)


def carried(cameras: Cameras) -> dict[str, float]:
    """``near_plane``, in scene units, and ``eps2d``, in pixels^2, of cameras (C,); gsplat's if they
    do not come from :func:`cameras_of_views`. Raises DataError if the cameras differ in them."""
    found = {"near_plane": NEAR_PLANE, "eps2d": EPS2D}
    for name in found:
        values = (cameras.metadata or {}).get(name)
        if values is not None and values.numel() > 0:
            different = values.unique().tolist()
            if len(different) != 1:
                raise DataError(
                    f"cameras of {len(different)} values of {name}; expected one for all views"
                )
            (found[name],) = different
    return found


def need_pinhole(camera: Cameras) -> None:
    """Raise a DataError if a camera (1,) has a lens. Datasets have none; camera paths of the viewer
    may. The viewer draws in a thread, which an error would end: there such a camera is drawn as a
    pinhole, as by nerfstudio's Splatfacto."""
    kind = CameraType(int(camera.camera_type))
    if kind != CameraType.PERSPECTIVE and threading.current_thread() is threading.main_thread():
        raise DataError(
            f"cameras of kind {kind.name.lower()}: expected perspective ones; choose Perspective "
            "in the render tab of the viewer, or change camera_type in the camera path"
        )


def views_of_cameras(
    cameras: Cameras, background: Tensor, rasterize_mode: RasterizeMode = "classic"
) -> Views:
    """nerfstudio cameras (C,), C at least 1, as pinhole views on their device, each of its image
    size. Lens distortion is ignored. Raises DataError if the cameras differ in near plane or
    ``eps2d``."""
    same = carried(cameras)
    images = [
        ImageSize(int(width), int(height), same["eps2d"])
        for width, height in zip(cameras.width, cameras.height, strict=True)
    ]
    return Views(
        viewmats=viewmats_from_opengl(cameras.camera_to_worlds),
        Ks=cameras.get_intrinsics_matrices(),
        width=images[0].width,
        height=images[0].height,
        background=background,
        rasterize_mode=rasterize_mode,
        images=images,
        **same,
    )
