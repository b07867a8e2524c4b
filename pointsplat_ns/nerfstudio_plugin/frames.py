"""Posed photos as a pinhole camera takes them, loaded when they are needed, and kept in a cache of
bounded size.

The rasterizer draws pinholes. nerfstudio undistorts photos for training, but not those that
``ns-render dataset`` writes, nor the cameras that the viewer takes from a dataset, nor fisheyes
without distortion coefficients.
"""

from __future__ import annotations

import copy
import dataclasses
import threading
import warnings
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import psutil
import torch
from cachetools import LRUCache
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.scene.image_files import IMAGE_ERRORS, MOST_PIXELS, exif_hint, open_image
from pointsplat_ns.system.files import one_line
from pointsplat_ns.system.tensors import DOUBLES


class UndistortedDataset(InputDataset):
    """Photos, masks and pinhole ``cameras`` (C,) of a split, undistorted together by nerfstudio's
    own function.

    Raises DataError if a pose or an intrinsic is NaN or infinite, photos are of several times, or a
    lens cannot be undone; and when a photo or mask is read that is missing, broken, of another size
    than its camera, or not of 8 bits.
    """

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        if scale_factor != 1.0:
            # nerfstudio multiplies sizes of photos in float64, those of cameras in float32: 360 x
            # 0.35 is 125 or 126
            given = dataparser_outputs.cameras
            self.cameras.width, self.cameras.height = (
                (size.double() * scale_factor).long() for size in (given.width, given.height)
            )
        _need_sound_cameras(self)
        self.lens_cameras = self.cameras
        self.cameras = self._pinholes()

    def get_data(
        self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32"
    ) -> dict[str, Any]:
        """``image`` (H, W, 3 or 4), uint8 or float32 in [0, 1], of the pinhole camera, ``mask`` (H,
        W, 1) bool where the dataset has masks, and ``image_idx``.

        nerfstudio's own method opens both files again, by content: no file of the formats that
        :func:`~pointsplat_ns.scene.image_files.open_image` takes is another one to Pillow.
        """
        path = self.image_filenames[image_idx]
        masks = self._dataparser_outputs.mask_filenames
        try:
            if masks is not None:
                with open_image(masks[image_idx]):
                    pass
            with open_image(path) as photo:
                if photo.mode not in (
                    "L",
                    "RGB",
                    "RGBA",
                ):  # nerfstudio reads 16-bit greys modulo 256, indices as greys
                    raise ValueError(
                        f"its pixels are of mode {photo.mode}; expected 8-bit grey, RGB or RGBA; "
                        "convert it"
                    )
            with warnings.catch_warnings():  # of sizes below our limit
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                data = super().get_data(image_idx, image_type)
        except FileNotFoundError as error:
            raise DataError(
                f"{error.filename or path}: no such file, but frame {image_idx} of the dataset "
                "needs it"
            ) from error
        except (*IMAGE_ERRORS, AssertionError) as error:
            raise DataError(
                f"{path}: cannot be read as the photo of frame {image_idx}: {one_line(error)}"
            ) from error
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
        scalars = [
            cameras.fx,
            cameras.fy,
            cameras.cx,
            cameras.cy,
            cameras.width,
            cameras.height,
            cameras.camera_type,
        ]
        distortion = [] if cameras.distortion_params is None else [cameras.distortion_params]
        every = torch.cat([part.double() for part in (*scalars, *distortion)], dim=1).tolist()
        pinholes: dict[tuple[float, ...], tuple[float, ...]] = {}  # a capture has few lenses
        for index, lens in enumerate(map(tuple, every)):
            if lenses[index] and lens not in pinholes:
                nothing = np.zeros(
                    (int(cameras.height[index]), int(cameras.width[index])), np.uint8
                )
                K, image, _ = _undistorted(
                    cameras[index : index + 1], self.image_filenames[index], nothing, {}
                )
                pinholes[lens] = K[0, 0], K[1, 1], K[0, 2], K[1, 2], image.shape[1], image.shape[0]
        numbers = torch.tensor(
            [pinholes.get(lens, lens[:6]) for lens in map(tuple, every)], **DOUBLES
        )
        fx, fy, cx, cy, width, height = numbers.split(1, dim=1)
        intrinsics = fx.float(), fy.float(), cx.float(), cy.float(), width.long(), height.long()
        return Cameras(
            cameras.camera_to_worlds,
            *intrinsics,
            camera_type=CameraType.PERSPECTIVE,
            times=cameras.times,
            metadata=cameras.metadata,
        )


def _has_lens(cameras: Cameras) -> Tensor:
    """Whether each of the cameras (C,) is no pinhole, (C,) bool. A fisheye without distortion
    coefficients is none: angles, and not their tangents, are proportional to pixels."""
    lens = cameras.camera_type[:, 0] != CameraType.PERSPECTIVE.value
    return (
        lens if cameras.distortion_params is None else lens | cameras.distortion_params.any(dim=1)
    )


def _undistorted(
    camera: Cameras, path: Path, image: np.ndarray, data: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray, Tensor | None]:
    """Intrinsics (3, 3), photo and mask of the pinhole camera that is left of a camera (1,) with a
    lens and its photo (H, W) or (H, W, 3 or 4). Of ``data`` only the mask is read. Raises DataError
    if the lens cannot be undone."""
    single = camera.reshape(())
    distortion = (
        np.zeros(6, np.float32)
        if single.distortion_params is None
        else single.distortion_params.numpy()
    )
    try:
        K, image, mask = _undistort_image(
            single, distortion, data, image, single.get_intrinsics_matrices().numpy()
        )
    except (AssertionError, NotImplementedError, cv2.error) as error:
        raise DataError(
            f"{path}: the lens distortion of its camera cannot be undone: {error}"
        ) from error
    if image.size == 0 or not np.isfinite(K).all():
        raise DataError(
            f"{path}: the lens distortion of its camera leaves nothing of the photo; check its "
            "coefficients"
        )
    return K, image, mask


def _need_sound_cameras(dataset: InputDataset) -> None:
    """Refuse cameras with NaN, infinity or a size of no photo, and photos of a scene that moves.
    Those without times are taken to be of a still scene."""
    cameras = dataset.cameras
    paths = dataset.image_filenames
    numbers = [cameras.camera_to_worlds.flatten(1), cameras.fx, cameras.fy, cameras.cx, cameras.cy]
    bad = (
        (~torch.cat([part.double() for part in numbers], dim=1).isfinite().all(dim=1))
        .nonzero()[:, 0]
        .tolist()
    )
    if bad:
        raise DataError(
            f"{paths[bad[0]]}: the pose or the intrinsics of frame {bad[0]} hold NaN or infinity, "
            f"as do those of {len(bad) - 1} more of {len(cameras)}; expected numbers; correct them "
            "or leave the photo out"
        )
    width = cameras.width[:, 0].double()
    height = cameras.height[:, 0].double()
    odd = ((width < 1) | (height < 1) | (width * height > MOST_PIXELS)).nonzero()[:, 0].tolist()
    if odd:
        raise DataError(
            f"{paths[odd[0]]}: the camera of frame {odd[0]} has {int(width[odd[0]])} x "
            f"{int(height[odd[0]])} pixels; expected the size of its photo"
        )
    if cameras.times is not None and len(cameras.times.unique()) > 1:
        raise DataError(
            f"{paths[0].parent}: its {len(cameras)} photos are of {len(cameras.times.unique())} "
            "different times; expected photos of a scene that does not move, as Gaussians here "
            "have no time; take the photos of one moment"
        )


class MemoryCache:
    """A least-recently-used cache for values of several kinds, which their keys tell apart, bounded
    in bytes; a bound of 0 keeps nothing. Safe to share among threads. Values are not copied: do not
    write to them."""

    def __init__(self, max_bytes: int):
        self._entries: LRUCache[Hashable, tuple[Any, int]] = LRUCache(
            max_bytes, getsizeof=lambda entry: entry[1]
        )
        self._lock = threading.Lock()

    @classmethod
    def of(cls, gigabytes: float | None = None) -> MemoryCache:
        """A cache of this size, 10^9 bytes; by default of a quarter of the memory that is free
        now."""
        return cls(
            psutil.virtual_memory().available // 4 if gigabytes is None else int(gigabytes * 1e9)
        )

    def get(self, key: Hashable) -> Any:
        """The value of ``key``, which then counts as just used; None if there is none."""
        with self._lock:
            entry = self._entries.get(key)
        return None if entry is None else entry[0]

    def put(self, key: Hashable, value: Any) -> None:
        """Store a value, not None, by the size of its tensors, and drop the least recently used
        ones until the bound holds. A value larger than the whole cache is not stored."""
        size = tensor_bytes(value)
        with self._lock:
            if size <= self._entries.maxsize:
                self._entries[key] = value, size


def tensor_bytes(value: Any) -> int:
    """Bytes of all tensors in a dictionary, list, tuple or dataclass, at any depth."""
    if isinstance(value, torch.Tensor):
        return value.nbytes
    if dataclasses.is_dataclass(value):
        value = vars(value)
    parts = (
        value.values()
        if isinstance(value, Mapping)
        else value
        if isinstance(value, (list, tuple))
        else ()
    )
    return sum(map(tensor_bytes, parts))


Frame = tuple[Cameras, dict[str, Any]]
"""A camera of shape (1,), and what nerfstudio calls its data: a dictionary with the photo, its mask
and its index."""


class Frames(Sequence[Frame]):
    """The posed photos of one split: of an :class:`UndistortedDataset`, or another with
    ``cameras``, a length and ``get_data``. All on ``device``, and shared with the cache: do not
    write to them."""

    def __init__(
        self,
        dataset: Any,
        image_type: Literal["uint8", "float32"] = "uint8",
        cache: MemoryCache | None = None,
        device: torch.device | str = "cpu",
    ):
        self.dataset = dataset
        self.device = device
        self.image_type: Literal["uint8", "float32"] = image_type
        self.cache = MemoryCache.of() if cache is None else cache
        self._owner = object()

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        return self.camera(index), self.data(index)

    def camera(self, index: int) -> Cameras:
        """The camera (1,) of a photo."""
        index = range(len(self))[index]
        return copy.deepcopy(self.dataset.cameras[index : index + 1]).to(self.device)

    def data(self, index: int) -> dict[str, Any]:
        """The data of a photo."""
        index = range(len(self))[index]
        key = "photo", self._owner, index
        data = self.cache.get(key)
        if data is None:
            data = self.dataset.get_data(index, image_type=self.image_type)
            self.cache.put(key, data)
        return {
            **data,
            **{name: data[name].to(self.device) for name in ("image", "mask") if name in data},
        }
