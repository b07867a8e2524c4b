"""Photos in a folder with the poses of a file of cameras, for scenes that no run of nerfstudio made.

The frame of the poses is checked by small renders of the dense scene, and mended by a similarity where one is found.
Photos that fit worst are left out. Every eighth photo, by name, is held out of training, as INRIA's code, gsplat and
nerfstudio do.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.compression.optimiser import Example
from pointsplat_ns.compression.photo_repair import Photos
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import flip_camera_axes, invert_rigid, smallest_turn
from pointsplat_ns.io.camera_files import NamedViews, camera_files_near, read_named_views, transforms_beside
from pointsplat_ns.io.camera_files.cameras import Motion
from pointsplat_ns.io.camera_files.colmap import model_folder
from pointsplat_ns.io.files import bytes_text, logger, require_memory
from pointsplat_ns.io.photos import PhotoReader, photo_files, photos_of_cameras
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.looking.pose_check import POSE_CHECK, Likeness, likeness
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.views import View, Views, spread_indices


@dataclass(frozen=True)
class PosedPhotoSettings:
    """Settings, chosen on the poses of ten captures: photos and renders correlate by 0.78 to 0.92 in the right frame,
    by at most 0.36 where the world or the cameras are turned by axes, by 0.3 to 0.8 at four fifths of the scale."""

    least: int = 8
    """Least number of photos: fewer hold none out."""
    side: int = 1600
    """Longer side of photos, pixels, if no resolution is asked for, as in 3DGS training."""
    min_likeness: float = 0.5
    """Least mean correlation of renders and their photos."""
    sure_likeness: float = 0.75
    """With as much in the given frame, the world is not turned to find more."""
    searched: int = 4
    """Number of photos that other frames are tried on."""
    clear_likeness: float = 0.02
    """Advantage of a frame over the given one."""
    scale_steps: tuple[float, ...] = (1.1, 1.01, 1.002)
    """Factors between the scales that are tried, coarse to fine."""
    same_scale: float = 0.02
    """Deviation of a scale from 1 that is left as it is."""
    outlier_db: float = 6.0
    """Photos whose PSNR is so much below the median are left out, if that is also"""
    outlier_deviations: float = 4.0
    """so many standard deviations, which are estimated from the median deviation."""
    held_out_every: int = 8
    """One photo of this many is held out."""


POSED_PHOTOS = PosedPhotoSettings()


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """Photos of a scene, in its frame."""

    views: Views
    """The views of all cameras of the file."""
    training: Photos
    held_out: Photos
    model: Path
    """The file of cameras."""


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
    side = POSED_PHOTOS.side if resolution is None else max(resolution)
    views = replace(named.views, rasterize_mode="antialiased" if dense.antialiased else "classic")
    masks = model if model.is_dir() else model.parent
    indices = sorted(files)
    few = [indices[place] for place in spread_indices(len(indices), POSE_CHECK.views)]
    reader = PhotoReader(masks, POSE_CHECK.side)
    shown = {index: _example(reader, named, views, index, files[index]) for index in few}
    progress("finding the frame of the photos", 0.0)
    views = _in_frame(dense, named, views, shown, model)
    reader = PhotoReader(masks, side)
    taken = sum(math.prod(reader.size(files[index], named.cameras[index])) for index in indices)
    try:
        require_memory(folder, 4 * taken)  # with a mask
    except SceneError as error:
        raise DataError(f"{error}: lower --resolution") from error
    examples = _read_all(reader, named, views, files, progress)
    left_out = _outliers(dense, examples, progress)
    if left_out:
        worst = ", ".join(f"{files[index].name} ({psnr:.1f} dB)" for index, psnr in list(left_out.items())[:6])
        more = f" and {len(left_out) - 6} more" if len(left_out) > 6 else ""
        logger.info("photos that fit worst are left out: %s%s", worst, more)
    names = sorted(indices, key=lambda index: named.names[index])
    held = [index for index in names[:: POSED_PHOTOS.held_out_every] if index not in left_out]
    training = [index for index in names if index not in held and index not in left_out]
    logger.info(
        "photos: %d of %s, poses of %s; %d are held out; %s in memory",
        len(examples), folder, model, len(held), bytes_text(sum(_bytes_of(examples[i]) for i in examples)),
    )  # fmt: skip
    return PosedPhotos(views.resized(side), [examples[index] for index in training], [examples[index] for index in held], model)


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
    why = ""
    for place in places:
        transforms = transforms_beside(scene) if scene is not None else None
        try:
            named = read_named_views(place, transforms)
        except (DataError, SceneError) as error:
            if poses is not None:
                raise
            why = why or str(error)
            continue
        files = photos_of_cameras(folder, names, named)
        if len(files) >= POSED_PHOTOS.least:
            if len(files) < len(named.names):
                logger.info("%s: %d of its %d cameras have no photo in %s", place, len(named.names) - len(files),
                            len(named.names), folder)  # fmt: skip
            return place, named, files
        why = why or (
            f"{place}: {len(files)} of its {len(named.names)} cameras have a photo in {folder}; expected at least "
            f"{POSED_PHOTOS.least}. Names of cameras: {_two(named.names)}; of photos: {_two(names)}"
        )
    raise DataError(why)


def _two(names: list[str]) -> str:
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
    """PSNR of the photos that fit so much worse than the others that something must be wrong with them, worst first."""
    drawn = thinned(dense, POSE_CHECK.max_count)
    psnrs = {}
    for done, (index, example) in enumerate(examples.items()):
        psnrs[index] = likeness(drawn, [_small(example)]).psnr
        progress("comparing photos with the scene", (done + 1) / len(examples))
    values = torch.tensor([*psnrs.values()], **DOUBLES)
    middle = float(values.median())
    deviation = 1.4826 * float((values - middle).abs().median())
    bound = middle - max(POSED_PHOTOS.outlier_db, POSED_PHOTOS.outlier_deviations * deviation)
    return dict(sorted(((index, psnr) for index, psnr in psnrs.items() if psnr < bound), key=lambda pair: pair[1]))


def _small(example: Example) -> Example:
    """A photo of the size of small renders."""
    view = example.view
    k = max(1, max(view.width, view.height) // POSE_CHECK.side)
    width, height = max(1, view.width // k), max(1, view.height // k)
    image = F.interpolate(example.target.permute(2, 0, 1)[None].float() / 255, (height, width), mode="area")[0]
    mask = example.mask
    if mask is not None:
        mask = F.interpolate(mask.permute(2, 0, 1)[None].float(), (height, width), mode="area")[0].ge(0.5)
        mask = mask.permute(1, 2, 0)
    stretch = view.K.new_tensor([[width / view.width], [height / view.height], [1.0]])
    return Example(replace(view, K=view.K * stretch, width=width, height=height), image.permute(1, 2, 0), mask)


def _in_frame(dense: Gaussians, named: NamedViews, views: Views, shown: dict[int, Example], model: Path) -> Views:
    """The views in the frame of the scene, which a few of their photos tell. A frame that has to be mended is named in
    one line; a DataError if none fits."""
    drawn = thinned(dense, POSE_CHECK.max_count)
    indices = list(shown)
    searched = [indices[place] for place in spread_indices(len(indices), POSED_PHOTOS.searched)]

    def views_of(poses: Tensor) -> Views:
        return replace(views, viewmats=invert_rigid(poses)).relative_to(dense.offset)

    def fit(poses: Tensor, indices: list[int] = indices) -> Likeness:
        viewmats = views_of(poses).viewmats
        return likeness(
            drawn, [shown[i]._replace(view=replace(shown[i].view, viewmat=viewmats[i])) for i in indices]
        )

    poses, words = invert_rigid(views.viewmats), [""]
    placed, given = poses, fit(poses)
    found = given
    for frames, chosen in ((_known_frames, indices), (_turned_frames, searched)):
        if frames is _turned_frames and given.own >= POSED_PHOTOS.sure_likeness:
            break
        text, best = max(frames(named, poses), key=lambda frame: fit(frame[1], chosen).own)
        other = fit(best)
        if other.own > found.own + POSED_PHOTOS.clear_likeness:
            found, words, placed = other, [text], best
    scale = _best_scale(lambda factor: fit(_scaled(placed, factor)).own)
    if abs(scale - 1) > POSED_PHOTOS.same_scale:
        placed = _scaled(placed, scale)
        words.append(f"positions times {scale:.4g}")
    found = fit(placed)
    if not _fits(found):
        raise DataError(
            f"{model}: renders of the scene are unlike the photos in the frame of these poses and in all others that "
            f"were tried ({given.psnr:.1f} dB PSNR in {given.count} photos, correlation {given.own:.2f}; at best "
            f"{found.psnr:.1f} dB and {found.own:.2f}); expected the poses and photos that the scene was trained from, "
            "in its frame: put the dataparser_transforms.json of its run beside the scene, or name other poses "
            "(--poses)"
        )
    words = [word for word in words if word]
    if words:
        logger.info(
            "poses are moved into the frame of the scene: %s (%.1f -> %.1f dB PSNR in %d small photos)",
            ", ".join(words), given.psnr, found.psnr, found.count,
        )  # fmt: skip
    return views_of(placed)


def _fits(found: Likeness) -> bool:
    return found.own >= POSED_PHOTOS.min_likeness and found.own - found.others >= POSE_CHECK.min_advantage


def _scaled(poses: Tensor, factor: float) -> Tensor:
    return Motion(torch.eye(4, **DOUBLES)[:3], factor).of(poses)


def _best_scale(likeness_at: Callable[[float], float]) -> float:
    """The scale of positions with the greatest likeness: uphill by ever smaller steps, from 1 or, where that is
    unlike, from the best of a hundredth to a hundred."""
    scale = 1.0
    if likeness_at(scale) < POSED_PHOTOS.min_likeness:
        scale = max((1.25**power for power in range(-20, 21)), key=likeness_at)
    for step in POSED_PHOTOS.scale_steps:
        at = functools.cache(lambda power, start=scale, step=step: likeness_at(start * step**power))
        power = 0
        while abs(power) < 48:
            best = max((power, power - 1, power + 1), key=at)
            if best == power:
                break
            power = best
        low, middle, high = at(power - 1), at(power), at(power + 1)
        bend = low - 2 * middle + high
        scale *= step ** (power + (0.5 * (low - high) / bend if bend < 0 else 0.0))
        if abs(scale - 1) <= POSED_PHOTOS.same_scale:
            break
    return scale


Frame = tuple[str, Tensor]
"""What leads to a frame, and poses (C, 4, 4) from camera to world in it."""


def _known_frames(named: NamedViews, poses: Tensor) -> list[Frame]:
    """Frames that files tell of, and the one that nerfstudio makes of the poses."""
    frames = [("", poses)]
    raw = poses
    if named.motion is not None:
        raw = _undone(named.motion, poses)
        frames.append(("without dataparser_transforms.json", raw))
    if named.saved is not None:
        frames.append(("applied_transform undone", _undone(named.saved, raw)))
        upright = Motion(torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], **DOUBLES))
        for start in (raw, upright.of(raw)):
            frames.append(("oriented, centred and scaled as nerfstudio does", _as_nerfstudio(start)))
    return frames


def _turned_frames(named: NamedViews, poses: Tensor) -> Iterator[Frame]:
    """The poses with the world turned by axes, or the camera axes of OpenGL for those of OpenCV, or both."""
    for turn in _axis_turns():
        turned = Motion(torch.cat([turn, torch.zeros(3, 1, **DOUBLES)], dim=1)).of(poses)
        text = _turn_text(turn)
        yield text, turned
        yield ", ".join(filter(None, (text, "camera axes y and z turned around"))), flip_camera_axes(turned)


def _undone(motion: Motion, poses: Tensor) -> Tensor:
    """Poses before a motion."""
    turn, move = motion.transform[:, :3], motion.transform[:, 3]
    before = poses.clone()
    before[:, :3] = turn.T @ poses[:, :3]
    before[:, :3, 3] = (poses[:, :3, 3] / motion.scale - move) @ turn
    return before


def _as_nerfstudio(poses: Tensor) -> Tensor:
    """Poses that nerfstudio's dataparsers make of these: the mean of up along z, the mean of positions at the origin,
    the largest coordinate 1."""
    up = -poses[:, :3, 1].mean(0)
    turn = smallest_turn(up / up.norm().clamp_min(1e-9), torch.tensor([0.0, 0.0, 1.0], **DOUBLES))
    centre = poses[:, :3, 3].mean(0)
    moved = Motion(torch.cat([turn, -(turn @ centre)[:, None]], dim=1)).of(poses)
    return _scaled(moved, 1 / max(float(moved[:, :3, 3].abs().max()), 1e-12))


def _axis_turns() -> Iterator[Tensor]:
    """The 24 rotations (3, 3) of axes to axes, the identity first."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = torch.zeros(3, 3, **DOUBLES)
            turn[[0, 1, 2], list(order)] = torch.tensor(signs, **DOUBLES)
            if float(torch.linalg.det(turn)) > 0:
                yield turn


def _turn_text(turn: Tensor) -> str:
    """The turn as the axes of the scene, in those of the poses' world; empty for none."""
    axes = [("-" if float(row.sum()) < 0 else "") + "xyz"[int(row.abs().argmax())] for row in turn]
    return "" if axes == ["x", "y", "z"] else f"axes x, y, z of the scene are {', '.join(axes)} of the poses"
