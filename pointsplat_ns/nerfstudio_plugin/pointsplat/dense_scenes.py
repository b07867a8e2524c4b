"""Dense scenes whose own renders, from sampled poses or those of a dataset, take the place of
photos."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.frames import Frames, MemoryCache
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.sizes import RESOLUTION, subsampled
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import in_unit_range
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.views import RasterizeMode
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.view_sampling.sampler import sample_views

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig

Split = Literal["train", "test"]
"""The training photos of a dataset, or its held-out ones."""


class DenseScene:
    """A dense scene: its Gaussians, read from a 3DGS PLY when they are needed, and its own renders
    from sampled poses.

    Args:
        name: unique among the scenes in use.
        source: the file that holds the Gaussians.
        cache: for Gaussians and renders, shared among scenes.
        poses: how many poses are sampled if there is no dataset, their size and seed.
        device: where renders are computed.
    """

    has_photos = False
    """Whether ``frames`` are photos; otherwise they are the scene's own renders."""
    rasterize_mode: RasterizeMode = "classic"
    """Rasterize mode that the scene is rendered with."""

    def __init__(
        self,
        name: str,
        source: Path,
        cache: MemoryCache,
        poses: ScenesDataManagerConfig | None = None,
        device: torch.device | str = "cpu",
    ):
        self.name = name
        self.source = source
        self.cache = cache
        self._poses = poses
        self.device = device
        self.rendered: dict[Split, Frames] = {
            "train": Frames(RenderedDataset(self, "train"), "uint8", cache, device),
            "test": Frames(RenderedDataset(self, "test"), "float32", cache, device),
        }
        """Renders of the dense scene, in 8 bits as photos are from training poses, not rounded from
        held-out ones."""

    @property
    def sampled_poses(self) -> int:
        """Number of training poses to sample."""
        assert self._poses is not None
        return self._poses.sampled_poses

    @cached_property
    def identity(self) -> str:
        """Text by which a checkpoint records that the network was trained on this scene: the name,
        and a fingerprint of the file's size and of the bytes at both ends. It stays the same if the
        folder is moved."""
        size = self.source.stat().st_size
        read = 1 << 16
        with self.source.open("rb") as stream:
            content = stream.read(read)
            stream.seek(max(0, size - read))
            content += stream.read()
        return f"{self.name}/ply {hashlib.sha256(content + str(size).encode()).hexdigest()[:16]}"

    @property
    def background(self) -> Tensor:
        """Background colour (3,) in [0, 1]."""
        return torch.zeros(3, **FLOATS)

    def read_dense(self) -> Gaussians:
        """Read the Gaussians from the file, onto the CPU."""
        return read_scene(self.source)

    def dense(self, keep: bool) -> Gaussians:
        """The Gaussians, from the cache or the file. ``keep`` puts them into the cache if there is
        room."""
        key = "dense", self.name
        dense = self.cache.get(key)
        if dense is None:
            dense = self.read_dense()
            if keep:
                self.cache.put(key, dense)
        return dense

    def pruned(
        self, settings: PruneSettings, dense: Gaussians | None = None
    ) -> tuple[Gaussians, float]:
        """The pruned scene, and the share of Gaussians that it holds. ``dense`` are the scene's
        Gaussians, if they have been read."""
        dense = self.dense(keep=False) if dense is None else dense
        smaller = settings.prune(dense)
        return smaller, len(smaller) / max(1, len(dense))

    def training_background(self, data: Mapping[str, Any]) -> Tensor:
        """Background of a training step whose frame has this data, in [0, 1]: a colour (3,) or an
        image (H, W, 3)."""
        return self.background

    def cameras(self, split: Split) -> Cameras:
        """Pinhole cameras (C,) sampled, different ones for each split: a fifth as many are held
        out. Every second one of the training split is subsampled from a picture of the size that
        people look at. Raises DataError, which names the file, if nothing of the scene is
        visible."""
        assert self._poses is not None
        size = self._poses.sampled_size
        count = self.sampled_poses
        seed = random.Random(f"{self._poses.seed} poses {split}").getrandbits(31)
        try:
            views = sample_views(
                self.dense(keep=True),
                count if split == "train" else max(1, count // 5),
                *size,
                seed,
            )
        except DataError as error:
            raise DataError(f"{self.source}: {error}") from error
        cameras = cameras_of_views(views)
        if split == "train" and max(size) < max(RESOLUTION) and cameras.metadata is not None:
            cameras.metadata["eps2d"][1::2] = subsampled(views, max(RESOLUTION), max(size)).eps2d
        return cameras

    def frames(self, split: Split) -> Frames:
        """The images of a split: photos if the scene has them, else its own renders."""
        return self.rendered[split]


class RenderedDataset:
    """Renders of a dense scene from the cameras of a split, with the part of a dataset's interface
    that nerfstudio's viewer uses."""

    def __init__(self, scene: DenseScene, split: Split):
        self._scene = scene
        self._split = split

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras, found when they are first needed."""
        return self._scene.cameras(self._split)

    def __bool__(self) -> bool:
        return True  # of no scene are there no poses; nerfstudio asks before they have to be found

    def __len__(self) -> int:
        return len(self.cameras)

    @torch.no_grad()
    def get_data(
        self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32"
    ) -> dict[str, Any]:
        """An exact render (H, W, 3) on the CPU, integers in [0, 255] or floats in [0, 1], and its
        index."""
        scene = self._scene
        views = views_of_cameras(
            self.cameras[image_idx : image_idx + 1], scene.background, scene.rasterize_mode
        )
        image = render(scene.dense(keep=True).to(scene.device), views[0]).cpu()
        return {
            "image": (255 * image).round().to(torch.uint8) if image_type == "uint8" else image,
            "image_idx": image_idx,
        }

    def __getitem__(self, index: int) -> dict[str, Any]:
        _, data = self._scene.rendered[self._split][index]  # from the cache
        return {**data, "image": in_unit_range(data["image"])}
