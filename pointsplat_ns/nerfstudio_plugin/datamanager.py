"""A nerfstudio datamanager that reads each photo when a step needs it.

nerfstudio's own full-image datamanager decodes every photo at the first step and keeps all of them. Above 500 photos it
pins their memory, which raises without CUDA.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import torch
from nerfstudio.data.datamanagers.base_datamanager import DataManager, VanillaDataManager
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.frames import Frame, Frames, MemoryCache
from pointsplat_ns.nerfstudio_plugin.undistorted import UndistortedDataset

if TYPE_CHECKING:
    _Base = DataManager
else:
    _Base = VanillaDataManager


class SpiralSource(_Base):
    """A datamanager around whose first held-out camera ``ns-render spiral`` can draw.

    That command takes nerfstudio's ray-based datamanager and its kin alone, so this is one of them by name. Nothing of
    it is used: what derives from this has datasets and batches of its own.
    """

    device: torch.device | str

    def __init__(self) -> None:
        DataManager.__init__(self)

    @cached_property  # one that the viewer, which reads every property of a datamanager, leaves alone
    def eval_dataloader(self) -> FixedIndicesEvalDataloader:
        """Held-out cameras and photos, one at a time; a DataError if no frame is held out."""
        if not self.eval_dataset:
            raise DataError(
                f"{self.get_datapath()}: no frame is held out, so there is no camera to start from; expected at least "
                "one: change the dataparser's split"
            )
        return FixedIndicesEvalDataloader(input_dataset=self.eval_dataset, device=self.device, num_workers=0)


@dataclass
class LazyImageDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's full-image datamanager, with photos read when they are needed"""

    _target: type = field(default_factory=lambda: LazyImageDatamanager)
    cache_images: Literal["cpu", "gpu"] = "cpu"
    """Has no effect here: decoded photos stay in main memory, within cache_gigabytes."""
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """Type of the images in the cache and of those returned; uint8 takes a quarter of the memory."""
    cache_gigabytes: float | None = None
    """Memory for decoded photos; by default a quarter of the free memory. Photos that do not fit are read again."""


class LazyImageDatamanager(FullImageDatamanager[UndistortedDataset], SpiralSource):
    """Full images and cameras, in the order that nerfstudio's datamanager gives for the same seed, decoded lazily.

    Its datasets hold undistorted photos and pinhole cameras.
    """

    config: LazyImageDatamanagerConfig
    latest_photo: str = ""
    """Name of the photo of the latest training step."""

    @cached_property
    def frame_cache(self) -> MemoryCache:
        """Decoded photos of both splits."""
        return MemoryCache.of(self.config.cache_gigabytes)

    @cached_property
    def train_frames(self) -> Frames:
        """Training photos by index."""
        return self._frames_of(self.train_dataset)

    @cached_property
    def eval_frames(self) -> Frames:
        """Held-out photos by index."""
        return self._frames_of(self.eval_dataset)

    def _frames_of(self, dataset: UndistortedDataset) -> Frames:
        return Frames(dataset, self.config.cache_images_type, self.frame_cache, self.device)

    @property
    def fixed_indices_eval_dataloader(self) -> Frames:  # type: ignore[override]  # nerfstudio's is a list
        """Every held-out frame in order, decoded one after the other."""
        return self.eval_frames

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
        return self.eval_frames[index]
