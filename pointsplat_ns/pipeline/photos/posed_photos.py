"""Photos in a folder with the poses of a file of cameras, for scenes that no run of nerfstudio
made.

The frame of the poses is checked by small renders of the dense scene, and mended by a similarity
where one is found. Photos that fit worst are left out. Every eighth photo, by name, is held out of
training, as INRIA's code, gsplat and nerfstudio do.
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

LEAST_PHOTOS = 8
"""Fewer hold none out."""

_Read = TypeVar("_Read")


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """Photos of a scene, in its frame."""

    views: Views
    """The views of all cameras of the file."""
    training: Photos
    held_out: Photos
    poses: Path
    """The file of cameras."""


def read_with_photos(
    scene: Gaussians | Path | str,
    folder: Path,
    poses: object = None,
    data: object = None,
    resolution: tuple[int, int] | None = None,
    progress: Progress = silent,
    training: bool = True,
) -> tuple[Gaussians, PosedPhotos]:
    """Read a scene, and the photos in a folder, reduced to the resolution; they stay in memory, a
    byte a channel. Photos that cannot be used are named and left out.

    Args:
        scene: N Gaussians, or the path of a scene, beside which cameras and
            ``dataparser_transforms.json`` are looked for.
        folder: of the photos.
        poses: a file of cameras; by default one in the folder of the photos, above it, or beside
            the scene.
        data: of a run; expected to be None.
        resolution: width and height, pixels; the longer side bounds that of photos. By default
            1600.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].
        training: whether to read the photos that are not held out.

    Raises:
        SceneError: if ``poses`` is no path or None, or ``data`` is named.
        DataError: if there are no photos or poses, too few of them belong together, or renders of
            the scene are not like the photos in any frame that was tried; if most photos cannot be
            used, or they take more memory than is free.
    """
    if not (poses is None or isinstance(poses, (str, Path))) or without_poses(poses):
        raise SceneError(
            f"{folder}: photos need the file with their poses; expected its path, or none to look "
            "for it"
        )
    if data is not None:
        raise SceneError(
            f"{data}: the data of a run, but photos are read from {folder}; expected one of both"
        )
    dense, path = (
        (scene, None) if isinstance(scene, Gaussians) else (read_scene(scene), Path(scene))
    )
    model, named, files = _posed_files(folder, poses, path)
    order = sorted(files, key=lambda index: named.names[index])
    held = order[::8]
    side = 1600 if resolution is None else max(resolution)  # as in 3DGS training
    faults: dict[int, DataError] = {}
    masks = model if model.is_dir() else model.parent
    reader = PhotoReader(masks, side, folder)
    small = PhotoReader(masks, POSE_CHECK.side, folder)

    def size(index: int) -> int:
        masked = reader.mask_of(files[index], named.cameras[index]) is not None
        return (4 if masked else 3) * math.prod(reader.size(files[index], named.cameras[index]))

    sizes = _usable(size, sorted(files if training else held), faults)
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
    for why, lines in (
        ("cannot be used", [str(error) for error in faults.values()]),
        ("fit worst", [f"{files[index].name} ({psnr:.1f} dB)" for index, psnr in psnrs.items()]),
    ):
        if lines:
            more = f" and {len(lines) - 6} more" if len(lines) > 6 else ""
            logger.info("photos that %s are left out: %s%s", why, ", ".join(lines[:6]), more)
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
        len({*good} & {*held}),
        bytes_text(sum(sizes[index] for index in examples)),
    )
    apart = [examples[i] for i in good if i in held]
    return dense, PosedPhotos(
        views.resized(side), [examples[i] for i in good if i not in held], apart, model
    )


def held_out_psnrs(
    dense: Gaussians, results: Sequence[Gaussians], photos: Photos
) -> HeldOut | None:
    """PSNR of results in held-out photos, and of the dense scene, which is on the device that
    renders; None if there are no photos."""
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
    """What is read for each index, by two threads, and in ``faults`` the errors of the others.
    Raises the first error if most have one."""

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
    """A file of cameras, its cameras, and their photos by the indices of their views."""
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
        if len(files) >= LEAST_PHOTOS:
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
            "expected at least "
            f"{LEAST_PHOTOS}. Names of cameras: {_two(named.names)}; of photos: {_two(names)}"
        )
    raise DataError(why)


def _two(names: Sequence[str]) -> str:
    return ", ".join(repr(name[-60:]) for name in names[:2])


def _camera_files(folder: Path, scene: Path | None) -> list[Path]:
    """Files of cameras in the folder of photos, above it, or beside the scene."""
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
    """PSNR of the photos that fit much worse than the others, worst first: by 6 dB and by four
    standard deviations, estimated from the median deviation. Of seven captures, two photos of one
    are among them."""
    drawn = thinned(dense, POSE_CHECK.max_count)
    psnrs = {}
    for done, (index, example) in enumerate(examples.items()):
        psnrs[index] = likeness(drawn, [example]).psnr
        progress("comparing photos with the scene", (done + 1) / len(examples))
    values = torch.tensor([*psnrs.values()], **DOUBLES)
    middle = float(values.median())
    deviation = 1.4826 * float((values - middle).abs().median())
    bound = middle - max(6.0, 4 * deviation)
    return dict(
        sorted(
            ((index, psnr) for index, psnr in psnrs.items() if psnr < bound),
            key=lambda pair: pair[1],
        )
    )
