"""Pieces of dense scenes, as training scenes: many small scenes teach more than few large ones."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.cameras import views_of_cameras
from pointsplat_ns.nerfstudio_plugin.frames import Frames
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene, RenderedDataset
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refinement.scene_cut import SceneCut, cut_scene
from pointsplat_ns.rendering import render_with_alpha
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.files import write_tensors

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig

PIECES = 12000
"""Largest number of Gaussians of a piece by default."""

FEWEST_LEFT = 32
"""Gaussians of the smallest pruned piece that is trained on."""

PIECE_FORMAT = "pointsplat-piece/1"


@dataclass(frozen=True, eq=False)
class CutScene:
    """A dense scene and one cut of it, of several that begin with pieces of ``most`` Gaussians."""

    whole: DenseScene
    cut: SceneCut
    seed: int
    most: int

    def members(self, number: int) -> Tensor:
        """Indices of the dense scene's Gaussians in a piece. # [n] int64"""
        return (self._pieces == number).nonzero()[:, 0]

    @cached_property
    def _pieces(self) -> Tensor:
        return self.cut.pieces_of(self.whole.dense(keep=True).means)

    def pruned(self, settings: PruneSettings) -> tuple[list[Gaussians], float]:
        """The pruned scene by pieces, and the share of Gaussians that it holds. The scene is pruned
        as a whole, so that pieces are what a network sees of a whole scene."""
        key = "pieces", self.whole.name, self.seed, settings
        found = self.whole.cache.get(key)
        if found is None:
            dense = self.whole.dense(keep=True)
            shared = "pruned whole", self.whole.name, settings
            smaller = self.whole.cache.get(shared)
            if smaller is None:
                smaller = settings.prune(dense)
                self.whole.cache.put(shared, smaller)
            pieces = self.cut.pieces_of(smaller.means)
            parts = [smaller[pieces == number] for number in range(self.cut.count)]
            found = parts, len(smaller) / len(dense)
            self.whole.cache.put(key, found)
        return found


class ScenePiece(DenseScene):
    """A piece of a dense scene, drawn alone: with opacity, so that it can be put over any
    background.

    Args:
        of: the scene and its cut.
        number: of the piece.
        poses: how many poses are sampled, their size and seed.
    """

    def __init__(self, of: CutScene, number: int, poses: ScenesDataManagerConfig):
        whole = of.whole
        super().__init__(
            f"{whole.name}/{of.seed}.{number}", whole.source, whole.cache, poses, whole.device
        )
        self.of = of
        self.number = number
        self.rasterize_mode = whole.rasterize_mode
        self.rendered = {
            "train": Frames(RenderedPiece(self), "uint8", whole.cache, whole.device),
            "test": Frames(RenderedPiece(self), "uint8", whole.cache, whole.device),
        }

    @property
    def sampled_poses(self) -> int:
        """Number of poses to sample of a piece."""
        assert self._poses is not None
        return self._poses.piece_poses

    @cached_property
    def identity(self) -> str:
        """That of the whole scene."""
        return self.of.whole.identity

    def training_background(self) -> Tensor:
        """A random colour (3,) of torch's generator: behind a hole in a piece may be anything."""
        return torch.rand(3, dtype=torch.float32, device="cpu")

    def read_dense(self) -> Gaussians:
        """The piece's Gaussians, of the dense scene."""
        return self.of.whole.dense(keep=True)[self.of.members(self.number)]

    def pruned(
        self, settings: PruneSettings, dense: Gaussians | None = None
    ) -> tuple[Gaussians, float]:
        """The piece's part of the pruned scene, and the share that the whole one keeps."""
        pieces, kept = self.of.pruned(settings)
        return pieces[self.number], kept

    def why_not(self, settings: Sequence[PruneSettings]) -> str:
        """Why the piece cannot be trained on with any of these settings; empty if it can."""
        for one in settings:
            left = int(self.pruned(one)[0].usable().sum())
            if left < FEWEST_LEFT:
                return f"{left} of its Gaussians are left of a pruned scene"
        try:
            _ = self.rendered["train"].dataset.cameras
        except DataError as error:
            return str(error)
        return ""

    def frames(self, split: Literal["train", "test"]) -> Frames:
        """The piece's own renders; none is held out."""
        return self.rendered["train"]


class RenderedPiece(RenderedDataset):
    """Renders of a piece with opacity, kept in a file if the training keeps pieces in a folder."""

    def __init__(self, piece: ScenePiece):
        super().__init__(piece, "train")
        self._piece = piece

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras, sampled when they are first needed, or those of the piece's file."""
        return self._content()[0]

    @torch.no_grad()
    def get_data(
        self, image_idx: int, image_type: Literal["uint8", "float32"] = "uint8"
    ) -> dict[str, Any]:
        """A render (H, W, 4) on the CPU, integers in [0, 255], colours not multiplied by opacity,
        and its index."""
        return {"image": self._content()[1][image_idx], "image_idx": image_idx}

    def _content(self) -> tuple[Cameras, Tensor]:
        """Cameras (C,) and renders (C, H, W, 4) uint8, from memory, from the file, or made now.
        Raises DataError, which names the scene, if nothing of the piece is visible."""
        piece = self._piece
        key = "piece", piece.name
        found = piece.cache.get(key)
        if found is None:
            path = self._path
            kept = None if path is None or not path.is_file() else read_piece(path)
            found = self._made() if kept is None else kept
            if kept is None and path is not None:
                write_piece(path, *found)
            piece.cache.put(key, found)
        return found

    @torch.no_grad()
    def _made(self) -> tuple[Cameras, Tensor]:
        piece = self._piece
        cameras = piece.cameras("train")
        dense = piece.dense(keep=True).to(piece.device)
        images = []
        for index in range(len(cameras)):
            views = views_of_cameras(
                cameras[index : index + 1], piece.background, piece.rasterize_mode
            )
            color, alpha = render_with_alpha(dense, views[0])
            straight = (color / alpha.clamp(min=1e-6)).clamp(0, 1)
            image = torch.cat([straight, alpha], dim=2)
            images.append((255 * image).round().to(torch.uint8).cpu())
        return cameras, torch.stack(images)

    @property
    def _path(self) -> Path | None:
        """The piece's file, named by all that determines its content."""
        piece = self._piece
        poses = piece._poses
        assert poses is not None
        if poses.pieces_folder is None:
            return None
        settings = (poses.piece_poses, poses.sampled_size, poses.seed, piece.of.most)
        text = f"{piece.identity} {piece.of.seed} {piece.number} {settings}"
        digest = hashlib.sha256(text.encode()).hexdigest()[:24]
        return Path(poses.pieces_folder) / f"{digest}.safetensors"


def count_of(scene: DenseScene) -> int | None:
    """Number of Gaussians of a training scene; None, and a line in the log, if it cannot be read or
    none of them can be drawn."""
    try:
        usable = scene.dense(keep=True).usable()
    except PointSplatError as error:
        CONSOLE.log(f"{scene.name} is left out: {error}")
        return None
    if not bool(usable.any()):
        CONSOLE.log(f"{scene.name} is left out: none of its Gaussians can be drawn")
        return None
    return len(usable)


def cut_scenes(
    scenes: Sequence[DenseScene], most: int, config: ScenesDataManagerConfig
) -> list[ScenePiece]:
    """The pieces of readable scenes, of at most ``most`` Gaussians, in all cuts of the
    datamanager's configuration. Each further cut has pieces of two thirds of the size."""
    found: list[ScenePiece] = []
    for scene in scenes:
        dense = scene.dense(keep=True)
        means = dense.means[dense.usable()]
        for number in range(config.cuts):
            seed = random.Random(f"{config.seed} cut {number}").getrandbits(31)
            size = max(1, round(most * (2 / 3) ** number))
            cut = CutScene(scene, cut_scene(means, size, seed), seed, most)
            found += [ScenePiece(cut, piece, config) for piece in range(cut.cut.count)]
    return found


def write_piece(path: Path, cameras: Cameras, images: Tensor) -> None:
    """Write a piece's cameras (C,) and renders (C, H, W, 4) uint8 to a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = cameras.metadata or {}
    tensors = {
        "camera_to_worlds": cameras.camera_to_worlds,
        "fx": cameras.fx,
        "fy": cameras.fy,
        "cx": cameras.cx,
        "cy": cameras.cy,
        "near_plane": metadata["near_plane"],
        "eps2d": metadata["eps2d"],
        "images": images,
    }
    write_tensors(
        path,
        {name: tensor.contiguous() for name, tensor in tensors.items()},
        {"format": PIECE_FORMAT},
    )


def read_piece(path: Path) -> tuple[Cameras, Tensor] | None:
    """Cameras and renders of a piece's file; None if it is not usable, so that it is made again."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        found = load_file(path)
        images = found["images"]
        count, height, width, _ = images.shape
        fits = images.dtype == torch.uint8 and images.shape[3] == 4 and count > 0
        fits = fits and found["camera_to_worlds"].shape == (count, 3, 4)
        numbers = ("fx", "fy", "cx", "cy", "near_plane", "eps2d")
        fits = fits and all(found[name].shape == (count, 1) for name in numbers)
        fits = fits and all(
            bool(tensor.isfinite().all()) for tensor in found.values() if tensor.is_floating_point()
        )
        if not fits:
            return None
        cameras = Cameras(
            found["camera_to_worlds"],
            found["fx"],
            found["fy"],
            found["cx"],
            found["cy"],
            width,
            height,
            camera_type=CameraType.PERSPECTIVE,
            metadata={name: found[name] for name in ("near_plane", "eps2d")},
        )
    except (SafetensorError, OSError, KeyError, ValueError, RuntimeError):
        return None
    return cameras, images
