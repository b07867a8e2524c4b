"""nerfstudio dataparser for ScanNet++ (``scannetpp-seeded``): nerfstudio's own, and what splatting
needs beside it."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetpp, ScanNetppDataParserConfig
from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import flip_camera_axes
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.system.files import read_text
from pointsplat_ns.system.tensors import FLOATS, INDICES

SOURCES = (
    (
        "dslr/nerfstudio/transforms.json",
        "dslr/resized_images",
        "dslr/resized_anon_masks",
        "dslr/colmap",
    ),
    # The dataset's toolkit writes these: photos undistorted by OpenCV, or by COLMAP; frames of the
    # iPhone's video.
    (
        "dslr/nerfstudio/transforms_undistorted.json",
        "dslr/undistorted_images",
        "dslr/undistorted_anon_masks",
        "dslr/colmap",
    ),
    ("nerfstudio/transforms.json", "images", "masks", "colmap"),
    ("iphone/nerfstudio/transforms.json", "iphone/rgb", "iphone/rgb_masks", "iphone/colmap"),
)
"""Transforms, photos, masks and COLMAP's model of all photos that a scene may have. The first whose
files are there are used."""


@dataclass
class SeededScanNetppDataParserConfig(ScanNetppDataParserConfig):
    """ScanNet++ without the frames that it marks as bad, and with COLMAP's points, from which
    Splatfacto starts

    Without paths of your own, the first of these is used whose photos are there: photos of the
    DSLR, undistorted ones of the dataset's toolkit, frames of the iPhone. Photos are held out by
    test_frames, else by train_test_lists.json. Where there is neither, or the photos of the test
    are hidden, every tenth is held out.
    """

    _target: type = field(default_factory=lambda: SeededScanNetpp)
    skip_bad: bool = True
    """Leave out frames with is_bad: blurred ones, or with shadows of the photographer."""
    load_seed_points: bool = True
    """Start from COLMAP's points."""
    colmap_path: Path = Path(SOURCES[0][-1])
    """Relative path to COLMAP's images and points3D, as text or binary files."""
    train_split_fraction: float | None = None
    """Train on this share of all photos and hold out the others, evenly spread, whatever the lists
    say."""


@dataclass
class SeededScanNetpp(ScanNetpp):
    """nerfstudio's ScanNet++ dataparser, which needs test_frames and all photos, uses bad frames
    and gives no seed points. Bad and hidden frames count in the orientation, centre and scale of
    all poses, as there."""

    config: SeededScanNetppDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:  # type: ignore[override]
        """See the base class. ``split`` is "train", or "val" or "test" for the photos that are held
        out. Raises DataError if the transforms file or COLMAP's files cannot be used, or photos are
        missing."""
        given = self.config
        located = _located(self.config)
        photos = located.data / located.images_dir
        meta, hidden = _split(located)
        frames = {frame["file_path"]: frame for frame in (*meta["frames"], *meta["test_frames"])}
        try:
            with tempfile.TemporaryDirectory() as folder:  # the base class reads a file
                completed = Path(folder) / "transforms.json"
                completed.write_text(json.dumps({**_intrinsics(meta["frames"][:1]), **meta}))
                self.config = dataclasses.replace(located, transforms_path=completed)
                outputs = super()._generate_dataparser_outputs(split)
        finally:
            self.config = given
        bad = {
            name for name, frame in frames.items() if self.config.skip_bad and frame.get("is_bad")
        }
        names = [str(path.relative_to(photos)) for path in outputs.image_filenames]
        kept = [i for i, name in enumerate(names) if name not in hidden | bad]
        if len(kept) < len(names):
            where = f"{located.data / located.transforms_path}: {split} split"
            if not kept:
                raise DataError(
                    f"{where}: all {len(names)} frames are hidden or marked is_bad; expected one "
                    "that is not; --skip-bad False takes bad ones"
                )
            missing = sum(name in hidden for name in names)
            log(
                f"{where}: of {len(names)} frames {len(names) - len(kept) - missing} that are "
                f"marked is_bad and {missing} that are hidden are left out"
            )
            outputs.image_filenames = [outputs.image_filenames[i] for i in kept]
            if outputs.mask_filenames is not None:
                outputs.mask_filenames = [outputs.mask_filenames[i] for i in kept]
            outputs.cameras = outputs.cameras[torch.tensor(kept, **INDICES)]
        shown = [frames[str(path.relative_to(photos))] for path in outputs.image_filenames]
        if _intrinsics(shown):
            outputs.cameras = _of_several_cameras(outputs.cameras, shown, meta, located)
        if split == "train" and self.config.load_seed_points:
            model = located.data / located.colmap_path
            points = list(_read(model, "points3D").values()) if model.is_dir() else []
            if not points:
                log(f"{model}: no points of COLMAP, so no seed points")
                return outputs
            poses = {
                name: np.array(frame["transform_matrix"], dtype=np.float64)
                for name, frame in frames.items()
            }
            move = _frame_of(model, poses)
            transform = outputs.dataparser_transform.double()
            xyz = torch.from_numpy(
                np.array([point.xyz for point in points]) @ move[:3, :3].T + move[:3, 3]
            )
            placed = (xyz @ transform[:, :3].T + transform[:, 3]) * outputs.dataparser_scale
            outputs.metadata["points3D_xyz"] = placed.float()
            outputs.metadata["points3D_rgb"] = torch.from_numpy(
                np.array([p.rgb for p in points], dtype=np.uint8)
            )
        return outputs


INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2")
"""Names of intrinsics and distortion in a transforms file, in nerfstudio's order."""


def _intrinsics(frames: list[dict[str, Any]]) -> dict[str, Any]:
    """Intrinsics that frames have of their own, as those of several cameras do; of each the first
    one found."""
    return {name: frame[name] for name in INTRINSICS for frame in reversed(frames) if name in frame}


def _of_several_cameras(
    cameras: Cameras,
    frames: list[dict[str, Any]],
    meta: dict[str, Any],
    config: SeededScanNetppDataParserConfig,
) -> Cameras:
    """Cameras (C,) with the intrinsics of their frames, or else those of all frames. Raises
    DataError if a frame has none."""
    try:
        said = [
            [float(frame.get(name, meta.get(name, 0.0))) for name in INTRINSICS] for frame in frames
        ]
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(
            f"{config.data / config.transforms_path}: {error}; expected intrinsics that are numbers"
        ) from error
    numbers = torch.tensor(said, **FLOATS)
    fx, fy, cx, cy, width, height = numbers[:, :6].split(1, dim=1)
    return Cameras(
        cameras.camera_to_worlds,
        fx,
        fy,
        cx,
        cy,
        width.long(),
        height.long(),
        distortion_params=numbers[:, 6:],
        camera_type=cameras.camera_type,
    )


def _located(config: SeededScanNetppDataParserConfig) -> SeededScanNetppDataParserConfig:
    """The config with the paths of the first source whose photos are there, unless one of its paths
    was given."""
    names = ("transforms_path", "images_dir", "masks_dir", "colmap_path")
    if tuple(map(Path, SOURCES[0])) == tuple(Path(getattr(config, name)) for name in names):
        for paths in SOURCES:
            if (config.data / paths[0]).is_file() and (config.data / paths[1]).is_dir():
                located: dict[str, Any] = dict(zip(names, map(Path, paths), strict=True))
                return dataclasses.replace(config, **located)
    return config


def _split(config: SeededScanNetppDataParserConfig) -> tuple[dict[str, Any], set[str]]:
    """The content of the transforms file with all photos either in ``frames`` or in
    ``test_frames``; and the names of hidden photos, those of official tests. Raises DataError if
    the file, or a training photo, cannot be used."""
    path = config.data / config.transforms_path
    photos = config.data / config.images_dir
    listed_in = path.parent.parent / "train_test_lists.json"
    expected = "expected JSON with frames, as ScanNet++ has it"
    try:
        meta = json.loads(read_text(path, 1 << 28))
        test = [dict(frame) for frame in meta.get("test_frames") or []]
        frames = [dict(each) for each in meta["frames"]]
        for frame in (*frames, *test):
            frame["file_path"] = _below(photos, frame["file_path"])
        listed = (
            set()
            if test or not listed_in.is_file()
            else set(json.loads(read_text(listed_in, 1 << 26))["test"])
        )
    except FileNotFoundError as error:
        raise DataError(
            f"{path}: no such file; {expected}; --data names the scene's folder"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: {type(error).__name__}: {error}; {expected}") from error
    test += [frame for frame in frames if frame["file_path"] in listed]
    frames = [frame for frame in frames if frame["file_path"] not in listed]
    missing = [
        frame["file_path"] for frame in frames if not (photos / frame["file_path"]).is_file()
    ]
    if missing:
        raise DataError(
            f"{photos}: {len(missing)} of {len(frames)} training photos are missing, first "
            f"{missing[0]}; expected all "
            f"frames of {path.name}; download them, or name their folder by --images-dir"
        )
    shown = [frame for frame in test if (photos / frame["file_path"]).is_file()]
    hidden = {frame["file_path"] for frame in test} - {frame["file_path"] for frame in shown}
    fraction = config.train_split_fraction
    if fraction is None and not shown:
        why = "the photos of the test are hidden" if hidden else "no photos are named for a test"
        log(f"{path}: {why}, so every tenth training photo is held out")
        fraction = (
            min(0.9, (len(frames) - 1.5) / len(frames)) if len(frames) > 1 else 0.9
        )  # of few photos one
    if fraction is not None:
        if not 0 < fraction < 1:
            raise DataError(f"--train-split-fraction {fraction}: expected above 0 and below 1")
        every = sorted([*frames, *shown], key=lambda frame: frame["file_path"])
        train, held_out = get_train_eval_split_fraction(
            [frame["file_path"] for frame in every], fraction
        )
        if len(held_out) == 0:
            raise DataError(f"{path}: {len(every)} photos; expected enough to hold out one of them")
        test = [every[i] for i in held_out] + [
            frame for frame in test if frame["file_path"] in hidden
        ]
        frames = [every[i] for i in train]
    return {**meta, "frames": frames, "test_frames": test}, hidden


def _below(photos: Path, name: str) -> str:
    """The path of a photo in its folder, from a path that may begin with the folder's name."""
    first, _, rest = name.partition("/")
    return rest if rest and first == photos.name and not (photos / name).is_file() else name


def _frame_of(folder: Path, poses: dict[str, np.ndarray]) -> np.ndarray:
    """The rigid motion (4, 4) from COLMAP's frame to that of ``poses``: camera-to-world (4, 4) in
    OpenGL axes, by the name of the photo. Raises DataError if they know no photo in common, or no
    motion takes the ones to the others."""
    from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat

    ours = []
    theirs = []
    for image in _read(folder, "images").values():
        if image.name in poses:
            viewmat = np.eye(4)
            viewmat[:3, :3] = qvec2rotmat(image.qvec)
            viewmat[:3, 3] = image.tvec
            theirs.append(flip_camera_axes(torch.from_numpy(np.linalg.inv(viewmat))).numpy())
            ours.append(poses[image.name])
    advice = "give the COLMAP model that the poses come from, or --load-seed-points False"
    if not ours:
        raise DataError(f"{folder}: COLMAP knows none of the {len(poses)} photos by name; {advice}")
    move = ours[0] @ np.linalg.inv(theirs[0])
    differences = np.abs(move @ np.stack(theirs) - np.stack(ours))
    centers = np.stack(ours)[:, :3, 3]
    apart = max(float(np.ptp(centers, axis=0).max()), 1e-9)
    worst = max(
        differences[:, :3, :3].max(), differences[:, :3, 3].max() / apart if len(ours) > 1 else 0.0
    )
    if not worst <= 1e-3:  # NaN fails too; transforms.json has six decimals
        raise DataError(
            f"{folder}: COLMAP's poses of {len(ours)} photos are not those of transforms.json, "
            f"moved as a whole (they differ by {worst:.2g}); {advice}"
        )
    return move


def _read(folder: Path, name: str) -> dict[int, Any]:
    """One of COLMAP's files, by nerfstudio's readers; a DataError if it is missing or broken."""
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    for suffix, kind in ((".bin", "binary"), (".txt", "text")):
        path = folder / f"{name}{suffix}"
        if path.is_file():
            try:
                return getattr(colmap, f"read_{name}_{kind}")(path)
            except Exception as error:  # these readers check nothing
                raise DataError(
                    f"{path}: cannot be read as COLMAP's: {type(error).__name__}: {error}"
                ) from error
    raise DataError(
        f"{folder}: no {name}.bin or {name}.txt; expected COLMAP's; or give --load-seed-points "
        "False"
    )
