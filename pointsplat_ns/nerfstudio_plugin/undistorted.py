"""A nerfstudio dataset whose photos are those of pinhole cameras, whatever the lens.

The rasterizer draws pinholes. nerfstudio undistorts the photos that a model is trained on, but neither those that
``ns-render dataset`` writes beside renders, nor the cameras that its other commands and the viewer take from a dataset;
nor does it undistort fisheyes without distortion coefficients.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.pictures import exif_hint
from pointsplat_ns.system.tensors import DOUBLES


class UndistortedDataset(InputDataset):
    """Photos, masks and cameras of a split, undistorted together by nerfstudio's own function.

    ``cameras`` (C,) are pinholes. They differ in size and intrinsics from ``lens_cameras``, which took the photos,
    where these have a lens. Raises DataError if a pose or an intrinsic is NaN or infinite, photos are of several times,
    or a lens cannot be undone; when a photo is read that is missing, broken, not the size that its camera says, or not
    of 8 bits a channel, or whose mask is.
    """

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        if scale_factor != 1.0:
            # nerfstudio multiplies sizes of photos in float64, those of cameras in float32: 360 x 0.35 is 125 or 126
            given = dataparser_outputs.cameras
            self.cameras.width, self.cameras.height = (
                (size.double() * scale_factor).long() for size in (given.width, given.height)
            )
        _need_sound_cameras(self)
        self.lens_cameras = self.cameras
        self.cameras = self._pinholes()

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """As nerfstudio's, of the pinhole camera: ``image`` (H, W, 3 or 4), uint8 or float32 in [0, 1], ``mask`` (H, W,
        1) bool where the dataset has masks, and ``image_idx``."""
        path = self.image_filenames[image_idx]
        try:
            _need_eight_bits(path)
            data = super().get_data(image_idx, image_type)
        except FileNotFoundError as error:
            raise DataError(
                f"{error.filename or path}: no such file, but frame {image_idx} of the dataset needs it"
            ) from error
        except (OSError, SyntaxError, ValueError, AssertionError) as error:
            raise DataError(f"{path}: cannot be read as the photo of frame {image_idx}: {error}") from error
        camera = self.lens_cameras[image_idx : image_idx + 1]
        height, width = data["image"].shape[:2]
        wanted = (int(camera.width), int(camera.height))
        if (width, height) != wanted:
            raise DataError(
                f"{path}: {width} x {height} pixels, but its camera says {wanted[0]} x {wanted[1]}"
                + (exif_hint(path, wanted) or "; give the camera the size of the photos")
            )
        if _has_lens(camera)[0]:
            _, image, mask = _undistorted(camera, path, data["image"].numpy(), data)
            data["image"] = torch.from_numpy(image)
            if mask is not None:
                data["mask"] = mask
        return data

    def _pinholes(self) -> Cameras:
        """Pinhole cameras (C,) of undistorted photos."""
        cameras = self.lens_cameras
        lenses = _has_lens(cameras)
        if not lenses.any():
            return cameras
        scalars = [cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height, cameras.camera_type]
        distortion = [] if cameras.distortion_params is None else [cameras.distortion_params]
        every = torch.cat([part.double() for part in (*scalars, *distortion)], dim=1)
        kinds, kind_of = every.unique(dim=0, return_inverse=True)
        pinholes = torch.empty(len(kinds), 6, **DOUBLES)
        for kind in range(len(kinds)):
            first = int((kind_of == kind).nonzero()[0, 0])
            if lenses[first]:
                width, height = int(cameras.width[first]), int(cameras.height[first])
                nothing = np.zeros((height, width), np.uint8)
                K, image, _ = _undistorted(cameras[first : first + 1], self.image_filenames[first], nothing, {})
                pinholes[kind] = torch.tensor(
                    [K[0, 0], K[1, 1], K[0, 2], K[1, 2], image.shape[1], image.shape[0]], **DOUBLES
                )
            else:
                pinholes[kind] = every[first, :6]
        fx, fy, cx, cy, width, height = pinholes[kind_of].split(1, dim=1)
        intrinsics = fx.float(), fy.float(), cx.float(), cy.float(), width.long(), height.long()
        return Cameras(
            cameras.camera_to_worlds, *intrinsics, camera_type=CameraType.PERSPECTIVE, times=cameras.times,
            metadata=cameras.metadata,
        )  # fmt: skip


def _has_lens(cameras: Cameras) -> Tensor:
    """Whether each of the cameras (C,) is something else than a pinhole, (C,) bool.

    A fisheye without distortion coefficients is: angles, and not their tangents, are proportional to pixels.
    """
    lens = cameras.camera_type[:, 0] != CameraType.PERSPECTIVE.value
    return lens if cameras.distortion_params is None else lens | cameras.distortion_params.any(dim=1)


def _undistorted(
    camera: Cameras, path: Path, image: np.ndarray, data: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray, Tensor | None]:
    """Intrinsics (3, 3), photo and mask of the pinhole camera that is left of a camera (1,) with a lens and its photo
    (H, W) or (H, W, 3 or 4). Of ``data`` only the mask is read. Raises DataError if the lens cannot be undone."""
    single = camera.reshape(())
    distortion = np.zeros(6, np.float32) if single.distortion_params is None else single.distortion_params.numpy()
    try:
        K, image, mask = _undistort_image(single, distortion, data, image, single.get_intrinsics_matrices().numpy())
    except (AssertionError, NotImplementedError, cv2.error) as error:
        raise DataError(f"{path}: the lens distortion of its camera cannot be undone: {error}") from error
    if image.size == 0 or not np.isfinite(K).all():
        raise DataError(
            f"{path}: the lens distortion of its camera leaves nothing of the photo; check its coefficients"
        )
    return K, image, mask


def _need_sound_cameras(dataset: InputDataset) -> None:
    """Refuse cameras with NaN or infinity, and photos of a scene that moves. Those without times are taken to be of a
    still scene."""
    cameras, paths = dataset.cameras, dataset.image_filenames
    numbers = [cameras.camera_to_worlds.flatten(1), cameras.fx, cameras.fy, cameras.cx, cameras.cy]
    bad = (~torch.cat([part.double() for part in numbers], dim=1).isfinite().all(dim=1)).nonzero()[:, 0].tolist()
    if bad:
        raise DataError(
            f"{paths[bad[0]]}: the pose or the intrinsics of frame {bad[0]} hold NaN or infinity, as do those of "
            f"{len(bad) - 1} more of {len(cameras)}; expected numbers; correct them or leave the photo out"
        )
    if cameras.times is not None and len(cameras.times.unique()) > 1:
        raise DataError(
            f"{paths[0].parent}: its {len(cameras)} photos are of {len(cameras.times.unique())} different times; "
            "expected photos of a scene that does not move, as Gaussians here have no time; take the photos of one "
            "moment"
        )


def _need_eight_bits(path: Path) -> None:
    """Refuse photos that nerfstudio would misread: 16-bit greys modulo 256, the indices of a palette as greys."""
    with Image.open(path) as photo:
        if photo.mode not in ("L", "RGB", "RGBA"):
            raise ValueError(f"its pixels are of mode {photo.mode}; expected 8-bit grey, RGB or RGBA; convert it")
