"""Dense scenes whose own renders take the place of photos.

They are rendered from the poses of the scene's dataset, or without a dataset from sampled poses. A folder
of PLY files can thus be a training set.
"""

from __future__ import annotations

import hashlib
import random
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from pointsplat_ns.comparing.sizes import RESOLUTION, subsampled
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.pictures import in_unit_range
from pointsplat_ns.io.scene import read_scene
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.frames import Frames, MemoryCache
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.views import RasterizeMode

Split = Literal["train", "test"]
"""The training photos of a dataset, or its held-out ones."""


@dataclass(frozen=True)
class SampledPoses:
    """Numbers of poses to sample in a scene without a dataset, and their image size in pixels."""

    train: int = 40
    test: int = 8
    width: int = 320
    height: int = 240
    seed: int = 0


class DenseScene:
    """A dense scene: its Gaussians, read from a 3DGS PLY when they are needed, and its own renders from sampled poses.

    Args:
        name: unique among the scenes in use.
        source: the file that holds the Gaussians.
        cache: for Gaussians and renders, shared among scenes.
        poses: how to sample poses if there is no dataset.
        device: where renders are computed.
    """

    has_photos = False
    """Whether ``train_frames`` and ``eval_frames`` are photos; otherwise they are the scene's own renders."""

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

    @cached_property
    def identity(self) -> str:
        """Text by which a checkpoint records that the network was trained on this scene: the name, and a fingerprint of
        the file's size and of the bytes at both ends. It stays the same if the folder is moved."""
        size, read = self.source.stat().st_size, 1 << 16
        with self.source.open("rb") as stream:
            content = stream.read(read)
            stream.seek(max(0, size - read))
            content += stream.read()
        return f"{self.name}/ply {hashlib.sha256(content + str(size).encode()).hexdigest()[:16]}"

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """Rasterize mode that the scene is rendered with."""
        return "classic"

    @property
    def background(self) -> Tensor:
        """Background colour (3,) in [0, 1]."""
        return torch.zeros(3, **FLOATS)

    def read_dense(self) -> Gaussians:
        """Read the Gaussians from the file, onto the CPU."""
        return read_scene(self.source)

    def dense(self, keep: bool) -> Gaussians:
        """The Gaussians, from the cache or the file. ``keep`` puts them into the cache if there is room."""
        key = "dense", self.name
        dense = self.cache.get(key)
        if dense is None:
            dense = self.read_dense()
            if keep:
                self.cache.put(key, dense)
        return dense

    def cameras(self, split: Split) -> Cameras:
        """Pinhole cameras (C,) sampled, different ones for each split. Every second one of the training
        split is subsampled from a picture of the size that people look at. Raises DataError, which names the file, if
        nothing of the scene is visible."""
        poses = self._poses
        seed = random.Random(f"{poses.seed} poses {split}").getrandbits(31)
        count = poses.train if split == "train" else poses.test
        try:
            views = sample_views(self.dense(keep=True), count, poses.width, poses.height, seed)
        except DataError as error:
            raise DataError(f"{self.source}: {error}") from error
        cameras, side = cameras_of_views(views), max(poses.width, poses.height)
        if split == "train" and side < max(RESOLUTION) and cameras.metadata is not None:
            cameras.metadata["eps2d"][1::2] = subsampled(views, max(RESOLUTION), side).eps2d
        return cameras

    @cached_property
    def rendered_train(self) -> Frames:
        """Renders of the dense scene from the training poses, in 8 bits as photos are."""
        return Frames(RenderedDataset(self, "train"), "uint8", self.cache, self._device)

    @cached_property
    def rendered_eval(self) -> Frames:
        """Renders of the dense scene from the held-out poses, not rounded."""
        return Frames(RenderedDataset(self, "test"), "float32", self.cache, self._device)

    @property
    def train_frames(self) -> Frames:
        """Training images: photos if the scene has them, else its own renders."""
        return self.rendered_train

    @property
    def eval_frames(self) -> Frames:
        """Held-out images: photos if the scene has them, else its own renders."""
        return self.rendered_eval

    @torch.no_grad()
    def picture(self, camera: Cameras) -> Tensor:
        """A render of the dense scene from a camera of shape (1,): (H, W, 3) in [0, 1], exact, on the CPU."""
        views = views_of_cameras(camera, self.background, self.rasterize_mode)
        return render(self.dense(keep=True).to(self._device), views[0]).cpu()


class RenderedDataset:
    """Renders of a dense scene from the cameras of a split, with the part of a dataset's interface that nerfstudio's
    viewer uses."""

    def __init__(self, scene: DenseScene, split: Split):
        self._scene, self._split = scene, split

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras, found when they are first needed."""
        return self._scene.cameras(self._split)

    def __bool__(self) -> bool:
        return True  # of no scene are there no poses; nerfstudio asks before they have to be found

    def __len__(self) -> int:
        return len(self.cameras)

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """A render, integers in [0, 255] or floats in [0, 1], and its index, as nerfstudio's datasets give photos."""
        image = self._scene.picture(self.cameras[image_idx : image_idx + 1])
        return {
            "image": (255 * image).round().to(torch.uint8) if image_type == "uint8" else image,
            "image_idx": image_idx,
        }

    def __getitem__(self, index: int) -> dict[str, Any]:
        frames = self._scene.rendered_train if self._split == "train" else self._scene.rendered_eval
        _, data = frames[index]  # from the cache
        return {**data, "image": in_unit_range(data["image"])}
