"""Photos in a folder with the poses of a file of cameras, for scenes that no run of nerfstudio made.

The frame of the poses is checked by small renders of the dense scene, and mended by a similarity where one is found.
Photos that fit worst are left out. Every eighth photo, by name, is held out of training, as INRIA's code, gsplat and
nerfstudio do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from pointsplat_ns.compression.compacted import Compacted, last_kept
from pointsplat_ns.compression.optimiser import Example
from pointsplat_ns.compression.photo_repair import Photos, mean_psnr
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.lenses import lens_of
from pointsplat_ns.io.camera_files import NamedViews, camera_files_near, read_named_views, transforms_beside
from pointsplat_ns.io.camera_files.colmap import model_folder
from pointsplat_ns.io.files import bytes_text, logger, require_memory
from pointsplat_ns.io.photos import PhotoReader, photo_files, photos_of_cameras
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.looking.photo_frame import in_frame
from pointsplat_ns.looking.pose_check import POSE_CHECK, likeness
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.views import Views, spread_indices

LEAST_PHOTOS = 8
"""Fewer hold none out."""


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """Photos of a scene, in its frame."""

    views: Views
    """The views of all cameras of the file."""
    training: Photos
    held_out: Photos


def read_posed_photos(
    dense: Gaussians,
    folder: Path | str,
    poses: Path | str | None = None,
    scene: Path | None = None,
    resolution: tuple[int, int] | None = None,
    progress: Progress = silent,
) -> PosedPhotos:
    """Read the photos in a folder, reduced to the resolution; they stay in memory, a byte a channel.

    Args:
        dense: N Gaussians.
        folder: of the photos.
        poses: a file of cameras; by default one in the folder of the photos, above it, or beside the scene.
        scene: file of the scene, beside which cameras and ``dataparser_transforms.json`` are looked for.
        resolution: width and height, pixels; the longer side bounds that of photos. By default 1600.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].

    Raises:
        DataError: if there are no photos or poses, too few of them belong together, or renders of the scene are not
            like the photos in any frame that was tried; if a photo cannot be read, or they take more memory than is
            free.
    """
    folder = Path(folder)
    model, named, files = _posed_files(folder, poses, scene)
    side = 1600 if resolution is None else max(resolution)  # as in 3DGS training
    masks = model if model.is_dir() else model.parent
    indices = sorted(files)
    few = [indices[place] for place in spread_indices(len(indices), POSE_CHECK.views)]
    reader = PhotoReader(masks, POSE_CHECK.side)
    shown = {index: _example(reader, named, named.views, index, files[index]) for index in few}
    progress("finding the frame of the photos", 0.0)
    views = in_frame(dense, named, shown, model)
    reader = PhotoReader(masks, side)
    taken = sum(math.prod(reader.size(files[index], named.cameras[index])) for index in indices)
    try:
        require_memory(folder, taken * (4 if any(named.cameras[index].mask for index in indices) else 3))
    except SceneError as error:
        raise DataError(f"{error}: lower --resolution") from error
    examples = _read_all(reader, named, views, files, progress)
    left_out = _outliers(dense, examples, progress)
    if left_out:
        worst = ", ".join(f"{files[index].name} ({psnr:.1f} dB)" for index, psnr in list(left_out.items())[:6])
        more = f" and {len(left_out) - 6} more" if len(left_out) > 6 else ""
        logger.info("photos that fit worst are left out: %s%s", worst, more)
    names = sorted(indices, key=lambda index: named.names[index])
    held = [index for index in names[::8] if index not in left_out]
    training = [index for index in names if index not in held and index not in left_out]
    bent = any(lens_of(named.cameras[index].model, named.cameras[index].distortion) for index in indices)
    logger.info(
        "photos: %d of %s" + (", undistorted" if bent else "") + ", poses of %s; %d are held out; %s in memory",
        len(examples), folder, model, len(held), bytes_text(sum(_bytes_of(examples[i]) for i in examples)),
    )  # fmt: skip
    return PosedPhotos(views.resized(side), [examples[i] for i in training], [examples[i] for i in held])


def held_out_text(dense: Gaussians, result: Compacted, photos: Photos) -> str:
    """Text on what training on photos did in held-out ones, at most twelve of them; ``dense`` is on the device that
    renders."""
    shown = spread_indices(len(photos), 12)
    at = next((place for place, stage in enumerate(result.stages) if stage.photos is not None), len(result.stages))
    scenes = (last_kept(result.stages[:at]).scene, result.scene, dense)
    before, after, best = (mean_psnr(scene.to(dense.device), photos, shown) for scene in scenes)
    return (
        f"held-out photos: {before:.1f} -> {after:.1f} dB PSNR in {len(shown)} photos, of the dense scene {best:.1f} dB"
    )


def _posed_files(
    folder: Path, poses: Path | str | None, scene: Path | None
) -> tuple[Path, NamedViews, dict[int, Path]]:
    """A file of cameras, its cameras, and their photos by the indices of their views."""
    names = photo_files(folder)
    places = [Path(poses)] if poses is not None else _camera_files(folder, scene)
    if not places:
        raise DataError(
            f"{folder}: no poses there, above it or beside the scene; name them (--poses): a COLMAP model, "
            "transforms.json of nerfstudio, or cameras.json of 3DGS"
        )
    transforms = None if scene is None else transforms_beside(scene)
    why = ""
    for place in places:
        try:
            named = read_named_views(place, transforms)
        except (DataError, SceneError) as error:
            if poses is not None:
                raise
            why = why or str(error)
            continue
        files = photos_of_cameras(folder, names, named)
        if len(files) >= LEAST_PHOTOS:
            if len(files) < len(named.names):
                logger.info("%s: %d of its %d cameras have no photo in %s", place, len(named.names) - len(files),
                            len(named.names), folder)  # fmt: skip
            return place, named, files
        why = why or (
            f"{place}: {len(files)} of its {len(named.names)} cameras have a photo in {folder}; expected at least "
            f"{LEAST_PHOTOS}. Names of cameras: {_two(named.names)}; of photos: {_two(names)}"
        )
    raise DataError(why)


def _two(names: Sequence[str]) -> str:
    return ", ".join(repr(name[-60:]) for name in names[:2])


def _camera_files(folder: Path, scene: Path | None) -> list[Path]:
    """Files of cameras in the folder of photos, above it, or beside the scene."""
    places: list[Path] = []
    for above in (folder.absolute(), folder.absolute().parent):
        places += [above / name for name in ("transforms.json", "cameras.json") if (above / name).is_file()]
        places += [above] if model_folder(above) is not None else []
    return [*places, *([] if scene is None else camera_files_near(scene))]


def _example(reader: PhotoReader, named: NamedViews, views: Views, index: int, path: Path) -> Example:
    photo = reader.read(path, named.cameras[index])
    height, width = photo.image.shape[:2]
    view = replace(views[index], K=photo.K.to(views.Ks), width=width, height=height)
    return Example(view, photo.image, photo.mask)


def _read_all(
    reader: PhotoReader, named: NamedViews, views: Views, files: dict[int, Path], progress: Progress
) -> dict[int, Example]:
    """The photos by the indices of their views; two threads decode."""
    examples: dict[int, Example] = {}
    with ThreadPoolExecutor(2, thread_name_prefix="photos") as pool:
        reading = pool.map(lambda index: _example(reader, named, views, index, files[index]), sorted(files))
        try:
            for index, example in zip(sorted(files), reading, strict=True):
                examples[index] = example
                progress("reading photos", len(examples) / len(files))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return examples


def _bytes_of(example: Example) -> int:
    return example.target.numel() + (0 if example.mask is None else example.mask.numel())


def _outliers(dense: Gaussians, examples: dict[int, Example], progress: Progress) -> dict[int, float]:
    """PSNR of the photos that fit much worse than the others, worst first: by 6 dB and by four standard deviations,
    estimated from the median deviation. Of seven captures, two photos of one are among them."""
    drawn = thinned(dense, POSE_CHECK.max_count)
    psnrs = {}
    for done, (index, example) in enumerate(examples.items()):
        psnrs[index] = likeness(drawn, [example]).psnr
        progress("comparing photos with the scene", (done + 1) / len(examples))
    values = torch.tensor([*psnrs.values()], **DOUBLES)
    middle = float(values.median())
    deviation = 1.4826 * float((values - middle).abs().median())
    bound = middle - max(6.0, 4 * deviation)
    return dict(sorted(((index, psnr) for index, psnr in psnrs.items() if psnr < bound), key=lambda pair: pair[1]))
