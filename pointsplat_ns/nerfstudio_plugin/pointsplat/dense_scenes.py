"""Dense scenes as their own references: what they show from some poses stands in for photos.

The poses are those of the scene's dataset, or ones sampled in the free space of a scene that comes without any, so
that a folder of PLY files is a training set.
"""

from __future__ import annotations

import copy
import hashlib
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from pointsplat_ns.compression.view_sampling import BACKGROUND, sample_views
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import content_hash
from pointsplat_ns.io.ply import read_ply
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.memory_cache import CacheKey, MemoryCache
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import RasterizeMode

Split = Literal["train", "test"]

_FINGERPRINT_BYTES = 1 << 16
"""Read at either end of a PLY to tell it from others: enough for thousands of numbers."""


@dataclass(frozen=True)
class DenseKey(CacheKey[Gaussians]):
    """Names the Gaussians of a scene in a cache that several scenes share."""

    scene: str


@dataclass(frozen=True)
class RenderKey(CacheKey[tuple[Cameras, dict[str, Any]]]):
    """Names a render of a scene in a cache that several scenes share."""

    scene: str
    split: Split
    index: int


@dataclass(frozen=True)
class SampledPoses:
    """How many poses, of what image size, are sampled in a scene that comes without any."""

    train: int = 40
    test: int = 8
    width: int = 320
    height: int = 240
    seed: int = 0


class DenseScene:
    """One scene, its Gaussians read when they are due, and what it shows from some poses.

    Args:
        name: unique among the scenes in use.
        source: the file that holds the Gaussians.
        cache: for Gaussians and pictures, shared among scenes.
        poses: how to sample poses where there are none.
        device: where pictures are drawn.
    """

    has_photos = False
    """Whether ``train_frames`` and ``eval_frames`` are photos; they are the scene's own renders otherwise."""

    def __init__(
        self,
        name: str,
        source: Path,
        cache: MemoryCache,
        poses: SampledPoses | None = None,
        device: torch.device | str = "cpu",
    ):
        self.name, self.source = name, source
        self.cache, self._device = cache, device
        self._poses = SampledPoses() if poses is None else poses

    @property
    def identity(self) -> str:
        """What a training remembers of the scene: the same wherever its folder is moved, and another for another
        training of a scene of that name."""
        raise NotImplementedError

    @cached_property
    def content(self) -> str:
        """SHA-256 of the file that holds the Gaussians: what is made of them and kept on disk is found by it."""
        return content_hash(self.source)

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """How the scene is drawn."""
        return "classic"

    @property
    def background(self) -> Tensor:
        """Colour (3,) in [0, 1] that the scene is drawn over."""
        return torch.tensor(BACKGROUND)

    def read_dense(self) -> Gaussians:
        """The Gaussians, read anew, on the CPU."""
        raise NotImplementedError

    def dense(self, keep: bool) -> Gaussians:
        """The Gaussians, from the cache if they are there; ``keep`` puts them there, as long as there is room."""
        dense = self.cache.get(DenseKey(self.name))
        if dense is None:
            dense = self.read_dense()
            if keep:
                self.cache.put(DenseKey(self.name), dense, sum(value.nbytes for value in dense.tensors()))
        return dense

    def cameras(self, split: Split) -> Cameras:
        """Pinhole cameras (C,) sampled in free space; none is in both splits.

        Raises:
            DataError: if the scene has nothing to look at, or no free place was found.
        """
        poses = self._poses
        seed = random.Random(f"{poses.seed} poses {split}").getrandbits(31)
        count = poses.train if split == "train" else poses.test
        return cameras_of_views(sample_views(self.dense(keep=True), count, poses.width, poses.height, seed))

    @cached_property
    def rendered_train(self) -> RenderedFrames:
        """What the dense scene shows from the training poses, in 8 bits as photos are."""
        return RenderedFrames(self, "train", "uint8")

    @cached_property
    def rendered_eval(self) -> RenderedFrames:
        """What the dense scene shows from the held-out poses, not rounded."""
        return RenderedFrames(self, "test", "float32")

    @property
    def train_frames(self) -> Any:
        """Training pictures: photos where the scene has them."""
        return self.rendered_train

    @property
    def eval_frames(self) -> Any:
        """Held-out pictures: photos where the scene has them."""
        return self.rendered_eval

    @torch.no_grad()
    def picture(self, camera: Cameras) -> Tensor:
        """What the dense scene shows a camera of shape (1,): (H, W, 3) in [0, 1], at exact quality, on the CPU.

        Lenses are left out: the picture is that of the pinhole camera with the same intrinsics.
        """
        views = views_of_cameras(camera, self.background, self.rasterize_mode)
        return render(self.dense(keep=True).to(self._device), views[0]).cpu()


class PlyScene(DenseScene):
    """A 3DGS PLY and nothing else: no photos, no poses.

    A PLY says nothing of its training, so its identity is its name and a fingerprint of its content.
    """

    def read_dense(self) -> Gaussians:
        """As the file has them."""
        return read_ply(self.source)

    @cached_property
    def identity(self) -> str:
        """The name, and a fingerprint of the file's size and of what is at its ends."""
        size = self.source.stat().st_size
        with self.source.open("rb") as stream:
            content = stream.read(_FINGERPRINT_BYTES)
            stream.seek(max(0, size - _FINGERPRINT_BYTES))
            content += stream.read()
        return f"{self.name}/ply {hashlib.sha256(content + str(size).encode()).hexdigest()[:16]}"


class RenderedFrames(Sequence[tuple[Cameras, dict[str, Any]]]):
    """Pictures that a dense scene gives of itself, drawn when they are asked for and kept while the cache has room.

    ``frames[i]`` is ``(camera, data)`` as that of :class:`~pointsplat_ns.nerfstudio_plugin.frames.Frames`.

    Args:
        scene: what is drawn.
        split: whose cameras they are drawn from.
        image_type: pictures in [0, 255] and rounded, or in [0, 1].
    """

    def __init__(self, scene: DenseScene, split: Split, image_type: Literal["uint8", "float32"]):
        self._scene, self._split, self.image_type = scene, split, image_type
        self.cameras = scene.cameras(split)

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, index: int) -> tuple[Cameras, dict[str, Any]]:  # type: ignore[override]
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        index %= len(self)
        key = RenderKey(self._scene.name, self._split, index)
        frame = self._scene.cache.get(key)
        if frame is None:
            camera = self.cameras[index : index + 1]
            image = self._scene.picture(camera)
            if self.image_type == "uint8":
                image = (255 * image).round().to(torch.uint8)
            frame = camera, {"image": image, "image_idx": index}
            self._scene.cache.put(key, frame, image.nbytes)
        return copy.deepcopy(frame[0]), frame[1].copy()

    def __iter__(self) -> Iterator[tuple[Cameras, dict[str, Any]]]:
        return (self[index] for index in range(len(self)))

    def prefetch(self, indices: Iterable[int]) -> None:
        """Nothing: to draw takes the processor that the step at hand needs."""

    @property
    def dataset(self) -> RenderedDataset:
        """As a nerfstudio dataset, for the viewer."""
        return RenderedDataset(self)


class RenderedDataset:
    """What nerfstudio reads of a dataset, of pictures that a scene gives of itself."""

    def __init__(self, frames: RenderedFrames):
        self._frames, self.cameras = frames, frames.cameras

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        _, data = self._frames[index]
        image = data["image"]
        return {**data, "image": image / 255 if image.dtype == torch.uint8 else image}
