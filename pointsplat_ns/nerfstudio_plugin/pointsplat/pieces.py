"""Pieces of dense scenes, as training scenes: many small scenes teach more than few large ones."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.cameras import views_of_cameras
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.frames import Frames
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene, RenderedDataset
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refinement.scene_cut import SceneCut, cut_scene
from pointsplat_ns.rendering import render, render_with_alpha
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

    def rest(self, number: int) -> Gaussians:
        """The dense scene without a piece."""
        return self.whole.dense(keep=True)[self._pieces != number]

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
    """A piece of a dense scene, drawn over the rest of it.

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

    def training_background(self, data: Mapping[str, Any]) -> Tensor:
        """The rest of the scene (H, W, 3) in [0, 1]."""
        return data["behind"].to(torch.float32) / 255

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


class PieceRenders(NamedTuple):
    """Cameras (C,) of a piece, and what they see."""

    cameras: Cameras
    images: Tensor  # [C, H, W, 4] uint8, the piece alone, colours not multiplied by opacity
    behind: Tensor  # [C, H, W, 3] uint8, the rest of the dense scene


class RenderedPiece(RenderedDataset):
    """Renders of a piece with opacity, and of the rest of its scene, over which it is trained: what
    shows through a hole, and what is spilled on, are what they are in the scene. They are kept in a
    file if the training keeps pieces in a folder."""

    def __init__(self, piece: ScenePiece):
        super().__init__(piece, "train")
        self._piece = piece

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras, sampled when they are first needed, or those of the piece's file."""
        return self._content().cameras

    @torch.no_grad()
    def get_data(
        self, image_idx: int, image_type: Literal["uint8", "float32"] = "uint8"
    ) -> dict[str, Any]:
        """A render (H, W, 4) on the CPU, integers in [0, 255], colours not multiplied by opacity,
        its index, and the rest of the scene (H, W, 3) as ``behind``."""
        _, images, behind = self._content()
        return {
            "image": images[image_idx],
            "image_idx": image_idx,
            "behind": behind[image_idx],
        }

    def _content(self) -> PieceRenders:
        """Cameras and renders, from memory, from the file, or made now. Raises DataError, which
        names the scene, if nothing of the piece is visible."""
        piece = self._piece
        key = "piece", piece.name
        found = piece.cache.get(key)
        if found is None:
            path = self._path
            kept = None if path is None or not path.is_file() else read_piece(path)
            found = self._made() if kept is None else kept
            if kept is None and path is not None:
                write_piece(path, found)
            piece.cache.put(key, found)
        return found

    @torch.no_grad()
    def _made(self) -> PieceRenders:
        piece = self._piece
        cameras = piece.cameras("train")
        dense = piece.dense(keep=True).to(piece.device)
        rest = piece.of.rest(piece.number).to(piece.device)
        images = []
        behind = []
        for index in range(len(cameras)):
            views = views_of_cameras(
                cameras[index : index + 1], piece.background, piece.rasterize_mode
            )
            color, alpha = render_with_alpha(dense, views[0])
            straight = (color / alpha.clamp(min=1e-6)).clamp(0, 1)
            images.append(_bytes(torch.cat([straight, alpha], dim=2)))
            behind.append(_bytes(render(rest, views[0])))
        return PieceRenders(cameras, torch.stack(images), torch.stack(behind))

    @property
    def _path(self) -> Path | None:
        """The piece's file, named by all that determines its content."""
        piece = self._piece
        poses = piece._poses
        assert poses is not None
        if poses.pieces_folder is None:
            return None
        settings = (poses.piece_poses, poses.sampled_size, poses.seed, piece.of.most)
        text = f"{PIECE_FORMAT} {piece.identity} {piece.of.seed} {piece.number} {settings}"
        digest = hashlib.sha256(text.encode()).hexdigest()[:24]
        return Path(poses.pieces_folder) / f"{digest}.safetensors"


def count_of(scene: DenseScene) -> int | None:
    """Number of Gaussians of a training scene; None, and a line in the log, if it cannot be read or
    none of them can be drawn."""
    try:
        usable = scene.dense(keep=True).usable()
    except PointSplatError as error:
        log(f"{scene.name} is left out: {error}")
        return None
    if not bool(usable.any()):
        log(f"{scene.name} is left out: none of its Gaussians can be drawn")
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
            cut = CutScene(whole=scene, cut=cut_scene(means, size, seed), seed=seed, most=most)
            found += [ScenePiece(cut, piece, config) for piece in range(cut.cut.count)]
    return found


def _bytes(image: Tensor) -> Tensor:
    """An image in [0, 1] as bytes, on the CPU."""
    return (255 * image.clamp(0, 1)).round().to(torch.uint8).cpu()


def write_piece(path: Path, renders: PieceRenders) -> None:
    """Write a piece's cameras and renders to a file."""
    cameras, images, behind = renders
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
        "behind": behind,
    }
    write_tensors(
        path,
        {name: tensor.contiguous() for name, tensor in tensors.items()},
        {"format": PIECE_FORMAT},
    )


def read_piece(path: Path) -> PieceRenders | None:
    """Cameras and renders of a piece's file; None if it is not usable, so that it is made again."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        found = load_file(path)
        images = found["images"]
        count, height, width, _ = images.shape
        fits = images.dtype == torch.uint8 and images.shape[3] == 4 and count > 0
        fits = fits and found["behind"].dtype == torch.uint8
        fits = fits and found["behind"].shape == (count, height, width, 3)
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
    return PieceRenders(cameras, images, found["behind"])
