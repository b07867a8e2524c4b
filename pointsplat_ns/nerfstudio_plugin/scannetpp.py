"""nerfstudio dataparser for ScanNet++ (``scannetpp-seeded``): nerfstudio's own, and what splatting needs beside it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetpp, ScanNetppDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import flip_camera_axes
from pointsplat_ns.io.files import read_text
from pointsplat_ns.system.tensors import INDICES


@dataclass
class SeededScanNetppDataParserConfig(ScanNetppDataParserConfig):
    """ScanNet++ without the frames that it marks as bad, and with COLMAP's points, from which Splatfacto starts"""

    _target: type = field(default_factory=lambda: SeededScanNetpp)
    """target class to instantiate"""
    skip_bad: bool = True
    """Leave out frames with is_bad: blurred ones, or with shadows of the photographer."""
    load_seed_points: bool = True
    """Start from COLMAP's points."""
    colmap_path: Path = Path("dslr/colmap")
    """Relative path to COLMAP's images and points3D, as text or binary files."""


@dataclass
class SeededScanNetpp(ScanNetpp):
    """nerfstudio's ScanNet++ dataparser, which uses bad frames and gives no seed points.

    The frame of all poses is nerfstudio's; bad ones count in its orientation, centre and scale, as there.
    """

    config: SeededScanNetppDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:  # type: ignore[override]
        """See the base class. ``split`` is "train" for ``frames``, "val" or "test" for ``test_frames``. Raises
        DataError if ``transforms.json`` or COLMAP's files cannot be used."""
        frames = self._frames()
        outputs = super()._generate_dataparser_outputs(split)
        if self.config.skip_bad:
            outputs = self._without(outputs, {name for name, frame in frames.items() if frame.get("is_bad")}, split)
        if split == "train" and self.config.load_seed_points:
            outputs.metadata.update(self._seed_points(frames, outputs))
        return outputs

    def _frames(self) -> dict[str, dict[str, Any]]:
        """Frames of both splits by the name of the photo."""
        path = self.config.data / self.config.transforms_path
        expected = "expected JSON with frames and test_frames, as ScanNet++ has it"
        try:
            meta = json.loads(read_text(path, 1 << 28))
            return {frame["file_path"]: frame for frame in (*meta["frames"], *meta["test_frames"])}
        except FileNotFoundError as error:
            raise DataError(f"{path}: no such file; {expected}; --data names the scene's folder") from error
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: {type(error).__name__}: {error}; {expected}") from error

    def _without(self, outputs: DataparserOutputs, bad: set[str], split: str) -> DataparserOutputs:
        """The outputs without bad frames."""
        photos = self.config.data / self.config.images_dir
        kept = [i for i, path in enumerate(outputs.image_filenames) if str(path.relative_to(photos)) not in bad]
        count = len(outputs.image_filenames)
        if len(kept) == count:
            return outputs
        if not kept:
            raise DataError(
                f"{self.config.data / self.config.transforms_path}: all {count} frames of the {split} split are marked "
                "is_bad; expected one that is not; --skip-bad False takes them all the same"
            )
        CONSOLE.log(f"{split} split: {count - len(kept)} of {count} frames are marked is_bad and left out")
        outputs.image_filenames = [outputs.image_filenames[i] for i in kept]
        if outputs.mask_filenames is not None:
            outputs.mask_filenames = [outputs.mask_filenames[i] for i in kept]
        outputs.cameras = outputs.cameras[torch.tensor(kept, **INDICES)]
        return outputs

    def _seed_points(self, frames: dict[str, dict[str, Any]], outputs: DataparserOutputs) -> dict[str, Tensor]:
        """COLMAP's points in the frame of the outputs."""
        folder = self.config.data / self.config.colmap_path
        if not folder.is_dir():
            CONSOLE.log(f"{folder}: no such folder, so no seed points; training starts from random ones")
            return {}
        poses = {name: np.array(frame["transform_matrix"], dtype=np.float64) for name, frame in frames.items()}
        move = _frame_of(folder, poses)
        points = _read(folder, "points3D").values()
        if not points:
            CONSOLE.log(f"{folder}: no points, so no seed points; training starts from random ones")
            return {}
        xyz = np.array([point.xyz for point in points]) @ move[:3, :3].T + move[:3, 3]
        transform = outputs.dataparser_transform.double()
        placed = torch.from_numpy(xyz) @ transform[:, :3].T + transform[:, 3]
        return {
            "points3D_xyz": (placed * outputs.dataparser_scale).float(),
            "points3D_rgb": torch.from_numpy(np.array([point.rgb for point in points], dtype=np.uint8)),
        }


def _frame_of(folder: Path, poses: dict[str, np.ndarray]) -> np.ndarray:
    """The rigid motion (4, 4) from COLMAP's frame to that of poses, found from the photos that both know.

    ``poses`` are camera-to-world (4, 4) in OpenGL axes by the name of the photo. Raises DataError if they know no photo
    in common, or no motion takes all poses of the one to the other.
    """
    from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat

    ours, theirs = [], []
    for image in _read(folder, "images").values():
        if image.name in poses:
            viewmat = np.eye(4)
            viewmat[:3, :3], viewmat[:3, 3] = qvec2rotmat(image.qvec), image.tvec
            theirs.append(flip_camera_axes(torch.from_numpy(np.linalg.inv(viewmat))).numpy())
            ours.append(poses[image.name])
    advice = "give the COLMAP model that the poses come from, or --load-seed-points False"
    if not ours:
        raise DataError(f"{folder}: COLMAP knows none of the {len(poses)} photos by name; {advice}")
    move = ours[0] @ np.linalg.inv(theirs[0])
    differences = np.abs(move @ np.stack(theirs) - np.stack(ours))
    centers = np.stack(ours)[:, :3, 3]
    apart = max(float(np.ptp(centers, axis=0).max()), 1e-9)
    worst = max(differences[:, :3, :3].max(), differences[:, :3, 3].max() / apart if len(ours) > 1 else 0.0)
    if not worst <= 1e-3:  # NaN fails too; transforms.json has six decimals
        raise DataError(
            f"{folder}: COLMAP's poses of {len(ours)} photos are not those of transforms.json, moved as a whole (they "
            f"differ by {worst:.2g}); {advice}"
        )
    return move


def _read(folder: Path, name: str) -> dict[int, Any]:
    """One of COLMAP's files, by nerfstudio's readers; a DataError if it is missing or broken."""
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    readers = {
        ("images", ".bin"): colmap.read_images_binary,
        ("images", ".txt"): colmap.read_images_text,
        ("points3D", ".bin"): colmap.read_points3D_binary,
        ("points3D", ".txt"): colmap.read_points3D_text,
    }
    for suffix in (".bin", ".txt"):
        path = folder / f"{name}{suffix}"
        if path.is_file():
            try:
                return readers[name, suffix](path)
            except Exception as error:  # these readers check nothing
                raise DataError(f"{path}: cannot be read as COLMAP's: {type(error).__name__}: {error}") from error
    raise DataError(f"{folder}: no {name}.bin or {name}.txt; expected COLMAP's; or give --load-seed-points False")
