"""Reads photos from a folder with poses from a camera file, for scenes without a nerfstudio run.

Small renders of the dense scene check the frame of the poses; a similarity corrects it where
possible. Outlier photos are left out. Every eighth photo, by name, is held out of training, as in
INRIA's code, gsplat and nerfstudio.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.geometry.lenses import lens_of
from pointsplat_ns.pipeline.photos.examples import Example, Photos, mean_psnr
from pointsplat_ns.pipeline.photos.frame import in_frame
from pointsplat_ns.pipeline.photos.pose_check import POSE_CHECK, likeness
from pointsplat_ns.pipeline.photos.posed_scene import without_poses
from pointsplat_ns.pipeline.report import HeldOut
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.scene.camera_files import (
    NamedViews,
    camera_files_near,
    read_named_views,
    transforms_beside,
)
from pointsplat_ns.scene.camera_files.colmap import model_folder
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.photo_files import PhotoReader, photo_files, photos_of_cameras
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.views import Views, spread_indices
from pointsplat_ns.system.files import bytes_text, logger, require_memory
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.view_sampling.content import thinned

MIN_PHOTOS = 8
"""Minimum number of photos with poses."""

_Read = TypeVar("_Read")


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """Photos of a scene, with views in its frame."""

    views: Views
    """Views of all cameras in the file."""
    training: Photos
    held_out: Photos
    poses: Path
    """The camera file."""


def read_with_photos(
    scene: Gaussians | Path | str,
    folder: Path,
    poses: object = None,
    data: object = None,
    resolution: tuple[int, int] | None = None,
    progress: Progress = silent,
    training: bool = True,
) -> tuple[Gaussians, PosedPhotos]:
    """Read a scene and the photos in a folder. Photos are reduced to the resolution and stay in
    memory, one byte per channel. Unusable photos are logged and left out.

    Args:
        scene: N Gaussians, or the path of a scene; a camera file and ``dataparser_transforms.json``
            may lie beside it.
        folder: folder of the photos.
        poses: camera file; by default one in the folder of photos, above it, or beside the scene.
        data: folder of a run's data; must be None.
        resolution: width and height, pixels; its longer side limits that of photos. By default
            1600.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].
        training: whether to read the photos that are not held out.

    Raises:
        SceneError: if ``poses`` is neither a path nor None, or ``data`` is given.
        DataError: if there are no photos or poses, too few photos have poses, renders of the scene
            do not match the photos in any tried frame, most photos are unusable, or they exceed the
            free memory.
    """
    if not (poses is None or isinstance(poses, (str, Path))) or without_poses(poses):
        raise SceneError(
            f"{folder}: photos need a camera file with their poses; expected its path, or no "
            "--poses to look for it"
        )
    if data is not None:
        raise SceneError(
            f"{data}: data of a run, but photos are read from {folder}; expected only one of both"
        )
    path = None if isinstance(scene, Gaussians) else Path(scene)
    dense = scene if isinstance(scene, Gaussians) else read_scene(scene)
    model, named, files = _posed_files(folder, poses, path)
    order = sorted(files, key=lambda index: named.names[index])
    held_out = order[::8]
    side = 1600 if resolution is None else max(resolution)  # as in 3DGS training
    faults: dict[int, DataError] = {}
    masks = model if model.is_dir() else model.parent
    reader = PhotoReader(masks, side, folder)
    small = PhotoReader(masks, POSE_CHECK.side, folder)

    def size(index: int) -> int:
        masked = reader.mask_of(files[index], named.cameras[index]) is not None
        return (4 if masked else 3) * math.prod(reader.size(files[index], named.cameras[index]))

    sizes = _usable(size, sorted(files if training else held_out), faults)
    try:
        require_memory(folder, sum(sizes.values()))
    except SceneError as error:
        raise DataError(f"{error}: lower --resolution") from error
    progress("finding the frame of the photos", 0.0)
    every = [index for index in sorted(files) if index not in faults]
    few = [every[place] for place in spread_indices(len(every), POSE_CHECK.views)]
    shown = _usable(
        lambda index: _example(small, named, named.views, index, files[index]), few, faults
    )
    views = in_frame(dense, named, shown, model)
    examples = _usable(
        lambda index: _example(reader, named, views, index, files[index]),
        [*sizes],
        faults,
        lambda done: progress("reading photos", done),
    )
    psnrs = _outliers(dense, examples, progress)
    for fault, lines in (
        ("are unusable", [str(error) for error in faults.values()]),
        (
            "match the scene worst",
            [f"{files[index].name} ({psnr:.1f} dB)" for index, psnr in psnrs.items()],
        ),
    ):
        if lines:
            more = f" and {len(lines) - 6} more" if len(lines) > 6 else ""
            logger.info("photos that %s are left out: %s%s", fault, ", ".join(lines[:6]), more)
    good = [index for index in order if index in examples and index not in psnrs]
    bent = any(
        lens_of(named.cameras[index].model, named.cameras[index].distortion) for index in examples
    )
    masked = any(reader.mask_of(files[index], named.cameras[index]) for index in examples)
    logger.info(
        "photos: %d of %s%s, poses of %s; %d are held out; %s in memory",
        len(examples),
        folder,
        ", undistorted" * bent + ", with masks" * masked,
        model,
        len({*good} & {*held_out}),
        bytes_text(sum(sizes[index] for index in examples)),
    )
    return dense, PosedPhotos(
        views=views.resized(side),
        training=[examples[index] for index in good if index not in held_out],
        held_out=[examples[index] for index in good if index in held_out],
        poses=model,
    )


def held_out_psnrs(
    dense: Gaussians, results: Sequence[Gaussians], photos: Photos
) -> HeldOut | None:
    """PSNR of results and of the dense scene in held-out photos, on the dense scene's device; None
    if there are no photos."""
    if not photos:
        return None
    shown = spread_indices(len(photos), VIEW_COUNTS.compared)
    *psnrs, best = (mean_psnr(scene.to(dense.device), photos, shown) for scene in (*results, dense))
    return HeldOut(photos=len(shown), psnrs=tuple(psnrs), dense=best)


def _usable(
    read: Callable[[int], _Read],
    indices: Sequence[int],
    faults: dict[int, DataError],
    progress: Callable[[float], None] = lambda done: None,
) -> dict[int, _Read]:
    """Read every index on two threads. Errors go to ``faults``; the first one is raised if most
    indices fail."""

    def attempt(index: int) -> _Read | DataError:
        try:
            return read(index)
        except DataError as error:
            return error

    found: dict[int, _Read] = {}
    with ThreadPoolExecutor(2, thread_name_prefix="photos") as pool:
        try:
            for done, (index, result) in enumerate(
                zip(indices, pool.map(attempt, indices), strict=True)
            ):
                if isinstance(result, DataError):
                    faults[index] = result
                else:
                    found[index] = result
                progress((done + 1) / len(indices))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if 2 * len(found) < len(indices):
        raise next(iter(faults.values()))
    return found


def _posed_files(
    folder: Path, poses: Path | str | None, scene: Path | None
) -> tuple[Path, NamedViews, dict[int, Path]]:
    """A camera file, its cameras, and their photos by view index."""
    names = photo_files(folder)
    places = [Path(poses)] if poses is not None else _camera_files(folder, scene)
    if not places:
        raise DataError(
            f"{folder}: no poses there, above it or beside the scene; name them (--poses): a "
            "COLMAP model, transforms.json of nerfstudio, or cameras.json of 3DGS"
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
        if len(files) >= MIN_PHOTOS:
            if len(files) < len(named.names):
                logger.info(
                    "%s: %d of its %d cameras have no photo in %s",
                    place,
                    len(named.names) - len(files),
                    len(named.names),
                    folder,
                )
            return place, named, files
        why = why or (
            f"{place}: {len(files)} of its {len(named.names)} cameras have a photo in {folder}; "
            f"expected at least {MIN_PHOTOS}. Names of cameras: {_two(named.names)}; of photos: "
            f"{_two(names)}"
        )
    raise DataError(why)


def _two(names: Sequence[str]) -> str:
    return ", ".join(repr(name[-60:]) for name in names[:2])


def _camera_files(folder: Path, scene: Path | None) -> list[Path]:
    """Camera files in the folder of photos, above it, or beside the scene."""
    places: list[Path] = []
    for above in (folder.absolute(), folder.absolute().parent):
        places += [
            above / name for name in ("transforms.json", "cameras.json") if (above / name).is_file()
        ]
        places += [above] if model_folder(above) is not None else []
    return [*places, *([] if scene is None else camera_files_near(scene))]


def _example(
    reader: PhotoReader, named: NamedViews, views: Views, index: int, path: Path
) -> Example:
    photo = reader.read(path, named.cameras[index])
    height, width = photo.image.shape[:2]
    view = replace(views[index], K=photo.K.to(views.Ks), width=width, height=height)
    return Example(view, photo.image, photo.mask)


def _outliers(
    dense: Gaussians, examples: Mapping[int, Example], progress: Progress
) -> dict[int, float]:
    """PSNR of outlier photos, worst first: below the median by 6 dB and by four standard
    deviations, estimated from the median absolute deviation. Seven captures have two, both in one
    capture."""
    drawn = thinned(dense, POSE_CHECK.max_count)
    psnrs = {}
    for done, (index, example) in enumerate(examples.items()):
        psnrs[index] = likeness(drawn, [example]).psnr
        progress("comparing photos with the scene", (done + 1) / len(examples))
    values = torch.tensor([*psnrs.values()], **DOUBLES)
    middle = float(values.median())
    deviation = 1.4826 * float((values - middle).abs().median())
    bound = middle - max(6.0, 4 * deviation)
    outliers = [(index, psnr) for index, psnr in psnrs.items() if psnr < bound]
    return dict(sorted(outliers, key=lambda pair: pair[1]))
