"""A nerfstudio datamanager that reads each photo when a step needs it.

nerfstudio's own full-image datamanager decodes every photo at the first step and keeps all of them.
Above 500 photos it pins their memory, which raises without CUDA.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.frames import Frame, Frames, MemoryCache, UndistortedDataset
from pointsplat_ns.nerfstudio_plugin.image_guard import photos_alone
from pointsplat_ns.system.files import one_line


@dataclass
class LazyImageDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's full-image datamanager, with photos read when they are needed"""

    _target: type = field(default_factory=lambda: LazyImageDatamanager)
    cache_images: Literal["cpu", "gpu"] = "cpu"
    """Has no effect here: decoded photos stay in main memory, within cache_gigabytes."""
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """Type of the images in the cache and of those returned; uint8 takes a quarter of the
    memory."""
    cache_gigabytes: float | None = None
    """Memory for decoded photos; by default a quarter of the free memory. Photos that do not fit
    are read again."""


class LazyImageDatamanager(FullImageDatamanager[UndistortedDataset]):
    """Full images, undistorted, and pinhole cameras, in the order of nerfstudio's datamanager for
    the same seed.

    Raises DataError if the dataparser finds fewer than two photos. nerfstudio's own dataparsers end
    in errors of all kinds then, such as a division by zero.
    """

    config: LazyImageDatamanagerConfig
    latest_photo: str = ""
    """Name of the photo of the latest training step."""

    def __init__(self, config: LazyImageDatamanagerConfig, *args: Any, **kwargs: Any):
        kind = type(config.dataparser).__name__.removesuffix("Config")
        expected = "expected two or more photos with poses in the layout that it reads"
        try:
            with photos_alone():
                super().__init__(config, *args, **kwargs)
        except PointSplatError:
            raise
        except (ArithmeticError, AssertionError, LookupError, OSError, ValueError) as error:
            raise DataError(
                f"{config.data}: {kind} cannot load training photos from it "
                f"({type(error).__name__}: {one_line(error, 120)}); {expected}"
            ) from error
        photos = {*self.train_dataset.image_filenames, *self.eval_dataset.image_filenames}
        if len(photos) < 2:
            raise DataError(f"{config.data}: {kind} finds one photo in it; {expected}")

    @cached_property
    def frame_cache(self) -> MemoryCache:
        """Decoded photos of both splits."""
        return MemoryCache.of(self.config.cache_gigabytes)

    @cached_property
    def train_frames(self) -> Frames:
        """Training photos by index."""
        return Frames(
            self.train_dataset, self.config.cache_images_type, self.frame_cache, self.device
        )

    @cached_property
    def fixed_indices_eval_dataloader(self) -> Frames:  # type: ignore[override]  # nerfstudio's is a list
        """Held-out photos by index."""
        return Frames(
            self.eval_dataset, self.config.cache_images_type, self.frame_cache, self.device
        )

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a training photo (the first one's, if they differ)."""
        cameras = self.train_dataset.cameras
        return int(cameras.height[0]) * int(cameras.width[0])

    def next_train(self, step: int) -> Frame:
        """The next training frame; each frame is used once before any is repeated."""
        index = self.train_unseen_cameras.pop(0)
        self.latest_photo = self.train_dataset.image_filenames[index].name
        if not self.train_unseen_cameras:
            self.train_unseen_cameras = self.sample_train_cameras()
        camera, data = self.train_frames[index]
        camera.metadata = {**(camera.metadata or {}), "cam_idx": index}
        return camera, data

    def next_eval_image(self, step: int) -> Frame:
        """A random held-out frame; each frame is used once before any is repeated."""
        index = self.eval_unseen_cameras.pop(random.randint(0, len(self.eval_unseen_cameras) - 1))
        if not self.eval_unseen_cameras:
            self.eval_unseen_cameras = list(range(len(self.eval_dataset)))
        return self.fixed_indices_eval_dataloader[index]
