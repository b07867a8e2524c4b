"""Posed photos, loaded when they are asked for and undistorted as nerfstudio does it.

nerfstudio's own full-image datamanager decodes every photo at the first step, keeps all of them and,
past 500 photos, pins their memory, which raises where there is no CUDA. Here a photo is decoded when
it is due, a few steps ahead and by a thread, and kept as long as a bounded cache has room for it.
"""

from __future__ import annotations

import copy
import itertools
import random
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import cv2
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
    _undistort_image,
)
from nerfstudio.data.datasets.base_dataset import InputDataset

from pointsplat_ns.errors import DataError

LOOK_AHEAD = 4
"""Photos decoded ahead of the one in use: enough to hide a decode behind a step, few enough to cost no memory."""

FALLBACK_CACHE_BYTES = 1 << 30
"""Size of the cache where the machine's free memory cannot be read."""


def free_memory_share(share: float = 0.25) -> int:
    """Bytes in a share of the memory that is available now."""
    try:
        import psutil

        return int(share * psutil.virtual_memory().available)
    except (ImportError, OSError):
        return FALLBACK_CACHE_BYTES


def _bytes_of(data: dict[str, Any]) -> int:
    return sum(value.numel() * value.element_size() for value in data.values() if isinstance(value, torch.Tensor))


class FrameCache:
    """Decoded photos up to a number of bytes, the longest unused dropped first. Safe to share among threads and
    among the :class:`Frames` of several scenes.

    Args:
        max_bytes: bound on the sum of what is kept; a photo larger than this is handed out and not kept.
    """

    def __init__(self, max_bytes: int):
        self.max_bytes = max_bytes
        self.num_bytes = 0
        self._entries: OrderedDict[tuple[int, int], tuple[tuple[Cameras, dict], int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[int, int]) -> tuple[Cameras, dict] | None:
        """What was kept under ``key``, marked as just used."""
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            return self._entries[key][0]

    def put(self, key: tuple[int, int], frame: tuple[Cameras, dict]) -> None:
        """Keep a frame, and drop the longest unused ones until the bound holds."""
        size = _bytes_of(frame[1])
        if size > self.max_bytes:
            return
        with self._lock:
            if key in self._entries:
                self.num_bytes -= self._entries.pop(key)[1]
            while self.num_bytes + size > self.max_bytes:  # make room first: the bound holds at every moment
                self.num_bytes -= self._entries.popitem(last=False)[1][1]
            self._entries[key] = (frame, size)
            self.num_bytes += size

    def __len__(self) -> int:
        return len(self._entries)


_frames_made = itertools.count()


class Frames(Sequence):
    """The posed photos of one split of a dataset.

    ``frames[i]`` is ``(camera, data)``: a nerfstudio camera of shape (1,) without lens distortion, and a fresh
    dictionary with ``image`` (H, W, 3 or 4; uint8 or float32 in [0, 1]), ``mask`` (H, W, 1) bool where the dataset
    has masks, and ``image_idx``. Image, mask and intrinsics are undistorted together by nerfstudio's own function,
    so that training and evaluation see the same pinhole camera whatever the lens. The tensors are shared with the
    cache: do not write to them.

    Args:
        dataset: a nerfstudio dataset; its cameras are read and never changed.
        image_type: as nerfstudio's ``cache_images_type``.
        cache: where decoded photos are kept; by default a cache of a quarter of the free memory.
        max_workers: threads that decode ahead.

    Raises:
        DataError: when a photo or mask is missing, broken or of another size than its camera.
    """

    def __init__(
        self,
        dataset: InputDataset,
        image_type: Literal["uint8", "float32"] = "uint8",
        cache: FrameCache | None = None,
        max_workers: int = 2,
    ):
        self.dataset = dataset
        self.image_type: Literal["uint8", "float32"] = image_type
        self.cache = FrameCache(free_memory_share()) if cache is None else cache
        self._number = next(_frames_made)  # names this object's photos in a shared cache
        self._max_workers = max_workers
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> tuple[Cameras, dict[str, Any]]:  # type: ignore[override]
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index %= len(self)
        with self._lock:
            loading = self._loading.get(index)
        frame = loading.result() if loading is not None else self.cache.get((self._number, index))
        if frame is None:
            frame = self._load_and_keep(index)
        camera, data = frame
        return copy.deepcopy(camera), data.copy()

    def __iter__(self) -> Iterator[tuple[Cameras, dict[str, Any]]]:
        for index in range(len(self)):
            self.prefetch(range(index + 1, min(index + 1 + LOOK_AHEAD, len(self))))
            yield self[index]

    def prefetch(self, indices: Iterable[int]) -> None:
        """Start decoding photos that will be asked for soon. What goes wrong is raised when they are."""
        for index in indices:
            with self._lock:
                if index in self._loading or self.cache.get((self._number, index)) is not None:
                    continue
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(self._max_workers, thread_name_prefix="frames")
                future = self._pool.submit(self._load_and_keep, index)
                self._loading[index] = future
            future.add_done_callback(lambda _, index=index: self._forget(index))

    def _forget(self, index: int) -> None:
        with self._lock:
            self._loading.pop(index, None)

    def _load_and_keep(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        frame = self._load(index)
        self.cache.put((self._number, index), frame)
        return frame

    def _load(self, index: int) -> tuple[Cameras, dict[str, Any]]:
        path = self.dataset.image_filenames[index]
        try:
            data = self.dataset.get_data(index, image_type=self.image_type)
        except FileNotFoundError as error:
            raise DataError(
                f"{error.filename or path}: no such file, but frame {index} of the dataset needs it"
            ) from error
        except (OSError, SyntaxError, ValueError, AssertionError) as error:
            raise DataError(f"{path}: cannot be read as the photo of frame {index}: {error}") from error
        camera = self.dataset.cameras[index : index + 1]
        height, width = data["image"].shape[:2]
        if (width, height) != (int(camera.width), int(camera.height)):
            raise DataError(
                f"{path}: {width} x {height} pixels, but its camera says {int(camera.width)} x {int(camera.height)}; "
                "give the camera the size of the photos"
            )
        try:
            return _undistorted(camera, data)
        except (AssertionError, NotImplementedError, cv2.error) as error:
            raise DataError(f"{path}: the lens distortion of its camera cannot be undone: {error}") from error


def _undistorted(camera: Cameras, data: dict[str, Any]) -> tuple[Cameras, dict[str, Any]]:
    """A pinhole camera and what it sees, from a camera of shape (1,) and its photo."""
    distortion = camera.distortion_params
    if distortion is None or not torch.any(distortion):
        return camera, data
    single = camera.reshape(())
    intrinsics, image, mask = _undistort_image(
        single, distortion[0].numpy(), data, data["image"].numpy(), single.get_intrinsics_matrices().numpy()
    )
    data["image"] = torch.from_numpy(image)
    if mask is not None:
        data["mask"] = mask
    pinhole = Cameras(
        camera_to_worlds=camera.camera_to_worlds,
        fx=float(intrinsics[0, 0]),
        fy=float(intrinsics[1, 1]),
        cx=float(intrinsics[0, 2]),
        cy=float(intrinsics[1, 2]),
        width=image.shape[1],
        height=image.shape[0],
        camera_type=CameraType.PERSPECTIVE,
        times=camera.times,
        metadata=camera.metadata,
    )
    return pinhole, data


class _DataView(Sequence):
    """The ``data`` half of some frames, for code that indexes nerfstudio's ``cached_train`` and ``cached_eval``."""

    def __init__(self, frames: Frames):
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> dict[str, Any]:  # type: ignore[override]
        return self._frames[index][1]


class _EvalLoader:
    """``(camera, data)`` of every held-out frame, on a device, one at a time."""

    def __init__(self, frames: Frames, device: torch.device | str):
        self._frames = frames
        self._device = device

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[tuple[Cameras, dict[str, Any]]]:
        return (to_device(frame, self._device) for frame in self._frames)


def to_device(frame: tuple[Cameras, dict[str, Any]], device: torch.device | str) -> tuple[Cameras, dict[str, Any]]:
    """A camera and its photo on a device."""
    camera, data = frame
    for name in ("image", "mask"):
        if name in data:
            data[name] = data[name].to(device)
    return camera.to(device), data


@dataclass
class LazyImageDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's full-image datamanager, with photos read when they are due."""

    _target: type = field(default_factory=lambda: LazyImageDatamanager)
    cache_images: Literal["cpu", "gpu"] = "cpu"
    """Has no effect here: decoded photos stay in main memory, within cache_gigabytes."""
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """The image type returned from manager, caching images in uint8 saves memory"""
    cache_gigabytes: float | None = None
    """Memory for decoded photos; by default a quarter of what is free. What does not fit is read again."""


class LazyImageDatamanager(FullImageDatamanager):
    """Full images and cameras in nerfstudio's order and for nerfstudio's seeds, decoded when they are due."""

    config: LazyImageDatamanagerConfig

    @cached_property
    def frame_cache(self) -> FrameCache:
        """Decoded photos of both splits."""
        gigabytes = self.config.cache_gigabytes
        return FrameCache(free_memory_share() if gigabytes is None else int(gigabytes * 1e9))

    @cached_property
    def train_frames(self) -> Frames:
        """Training photos by index."""
        return self._frames_of(self.train_dataset)

    @cached_property
    def eval_frames(self) -> Frames:
        """Held-out photos by index."""
        return self._frames_of(self.eval_dataset)

    def _frames_of(self, dataset: InputDataset) -> Frames:
        workers = self.config.max_thread_workers or 2
        return Frames(dataset, self.config.cache_images_type, self.frame_cache, workers)

    @property
    def cached_train(self) -> Sequence[dict[str, Any]]:  # type: ignore[override]
        """Training images by index, decoded on access."""
        return _DataView(self.train_frames)

    @property
    def cached_eval(self) -> Sequence[dict[str, Any]]:  # type: ignore[override]
        """Held-out images by index, decoded on access."""
        return _DataView(self.eval_frames)

    @property
    def train_cameras(self) -> Cameras:
        """Cameras of the training photos as the dataparser gave them, lens distortion included."""
        return self.train_dataset.cameras

    @property
    def fixed_indices_eval_dataloader(self) -> _EvalLoader:  # type: ignore[override]
        """Every held-out frame in order, decoded one after the other."""
        return _EvalLoader(self.eval_frames, self.device)

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a training photo (the first one's, if they differ)."""
        cameras = self.train_dataset.cameras
        return int(cameras.height[0]) * int(cameras.width[0])

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        """The next training frame, every one once before any twice."""
        index = self.train_unseen_cameras.pop(0)
        if not self.train_unseen_cameras:
            self.train_unseen_cameras = self.sample_train_cameras()
        frame = self.train_frames[index]
        self.train_frames.prefetch(self.train_unseen_cameras[:LOOK_AHEAD])
        camera, data = to_device(frame, self.device)
        camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
        return camera, data

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        """A held-out frame at random, every one once before any twice."""
        index = self.eval_unseen_cameras.pop(random.randint(0, len(self.eval_unseen_cameras) - 1))
        if not self.eval_unseen_cameras:
            self.eval_unseen_cameras = list(range(len(self.eval_dataset)))
        return to_device(self.eval_frames[index], self.device)
