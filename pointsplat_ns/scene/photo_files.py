"""Photos in a folder: matches them to cameras, and undistorts them to pinhole images."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.lenses import Lens, lens_of, pixel_map
from pointsplat_ns.scene.camera_files import NamedViews
from pointsplat_ns.scene.camera_files.camera_views import Camera
from pointsplat_ns.scene.image_files import IMAGE_ERRORS, exif_hint, open_image
from pointsplat_ns.system.files import one_line
from pointsplat_ns.system.tensors import DOUBLES

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")


def photo_files(folder: Path) -> list[str]:
    """Paths of the photos in or below a folder, relative to it with ``/`` as separator, sorted;
    without hidden files. Raises DataError if the folder is missing, or has no photo or too many."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; expected the folder of the photos")
    found: list[str] = []
    for place, inner, files in os.walk(folder):
        inner[:] = [name for name in inner if not name.startswith(".")]
        relative = Path(place).relative_to(folder)
        shown = (name for name in files if not name.startswith("."))
        found += [
            (relative / name).as_posix() for name in shown if name.lower().endswith(PHOTO_SUFFIXES)
        ]
        if len(found) > 100_000:
            raise DataError(
                f"{folder}: more than 100,000 photos; expected the folder of one capture's photos"
            )
    if not found:
        raise DataError(f"{folder}: no photo in it; expected files {', '.join(PHOTO_SUFFIXES)}")
    return sorted(found)


def photos_of_cameras(folder: Path, files: Sequence[str], named: NamedViews) -> dict[int, Path]:
    """The photo of each view by view index; views without a photo are omitted.

    A photo is matched by the name in the camera file: in the folder, else in the model's own
    folders, else as the only photo whose path ends in that name, suffixes ignored. A photo that
    matches two views is not used.
    """
    root = folder.absolute()
    known = set(files)
    by_end = defaultdict(list)
    for file in files:
        parts = _parts(file)
        for first in range(len(parts)):
            by_end[parts[first:]].append(file)
    found: dict[int, str] = {}
    for index, name in enumerate(named.names):
        plain = PurePosixPath(name.replace("\\", "/")).as_posix()
        own = named.photo(index)
        if own is not None and root in own.absolute().parents:
            own_name = own.absolute().relative_to(root).as_posix()
        else:
            own_name = ""
        if plain in known or own_name in known:
            found[index] = plain if plain in known else own_name
            continue
        parts = _parts(plain)
        ends = (by_end.get(parts[first:], []) for first in range(len(parts)))
        if len(same := next(filter(None, ends), [])) == 1:
            found[index] = same[0]
    taken = Counter(found.values())
    return {index: folder / file for index, file in found.items() if taken[file] == 1}


def _parts(name: str) -> tuple[str, ...]:
    """Folders and name of a photo, without its photo suffix."""
    path = PurePosixPath(name)
    return path.with_suffix("").parts if path.suffix.lower() in PHOTO_SUFFIXES else path.parts


@dataclass(frozen=True, eq=False)
class Photo:
    """An undistorted photo: a pinhole image."""

    image: Tensor  # [H, W, 3] uint8, transparent parts over black
    mask: Tensor | None  # [H, W, 1] bool, True for valid pixels; None if all are valid
    K: Tensor  # [3, 3] float64 intrinsics, pixels


class PhotoReader:
    """Reads photos of cameras: decoded at reduced size, undistorted, and with their masks.

    The pinhole has the focal lengths and the principal point of the camera. Pixels outside of the
    lens image are invalid. Undistortion maps are cached per lens, because a capture has few lenses.

    Args:
        masks: folder that contains, directly or below, the masks that cameras name.
        side: longer side of the images, pixels; smaller photos are not enlarged.
        folder: of the photos. If cameras name no mask, the mask of ``a.jpg`` is ``a.jpg.png``, as
            in COLMAP, or ``a.png``, in the folder ``masks`` beside ``folder``.
    """

    def __init__(self, masks: Path, side: int, folder: Path | None = None):
        self._masks = masks
        self._side = side
        self._folder = folder
        self._maps: dict[tuple, tuple[Tensor, Tensor]] = {}

    def size(self, path: Path, camera: Camera) -> tuple[int, int]:
        """Width and height, pixels, of the photo after reading. Does not decode pixels. Errors are
        those of :meth:`read`."""
        return self._opened(path, camera)[0]

    def read(self, path: Path, camera: Camera) -> Photo:
        """The photo of a camera. Raises DataError if it cannot be read, is too large, has another
        aspect ratio than the camera, or its lens cannot be undistorted."""
        from PIL import Image, ImageOps

        size, turned = self._opened(path, camera)
        try:
            with open_image(path) as opened:
                # JPEGs are decoded at a half or less
                opened.draft("RGB", size[::-1] if turned else size)
                kind = (
                    "RGBA"
                    if opened.mode in ("RGBA", "LA", "PA") or "transparency" in opened.info
                    else "RGB"
                )
                upright = ImageOps.exif_transpose(opened) if turned else opened
                picture = np.array(upright.convert(kind).resize(size, Image.Resampling.BOX))
        except IMAGE_ERRORS as error:
            raise DataError(f"{path}: cannot be read as a photo ({one_line(error, 80)})") from error
        image = torch.from_numpy(picture)
        if image.shape[2] == 4:
            image = (image[..., :3].int() * image[..., 3:].int() // 255).to(torch.uint8)
        mask = self._mask(path, camera, size)
        K = torch.eye(3, **DOUBLES)
        for axis in range(2):
            stretch = size[axis] / camera.size[axis]
            K[axis, axis] = camera.focal[axis] * stretch
            K[axis, 2] = camera.centre[axis] * stretch
        try:
            lens = lens_of(camera.model, camera.distortion)
        except ValueError as error:
            raise DataError(
                f"{path}: its camera has {error}; undistort the photos (colmap image_undistorter) "
                "and use the model that this writes"
            ) from error
        if lens is None:
            return Photo(image, mask, K)
        places, shown = self._map(path, lens, K, size)
        image = _sampled(image, places).round().to(torch.uint8)
        shown = shown if mask is None else shown & (_sampled(mask, places) > 0.5)
        return Photo(image, shown, K)

    def _opened(self, path: Path, camera: Camera) -> tuple[tuple[int, int], bool]:
        """Size of the photo, and whether to apply its EXIF orientation, which is the case if the
        camera belongs to the rotated photo."""
        try:
            with open_image(path) as opened:
                size = opened.size
                mode = opened.mode
                hint = exif_hint(path, (int(camera.size[0]), int(camera.size[1])))
        except IMAGE_ERRORS as error:
            raise DataError(f"{path}: cannot be read as a photo ({one_line(error, 80)})") from error
        if mode.startswith(("I", "F")):
            raise DataError(
                f"{path}: its pixels are of mode {mode}; expected 8 bits a channel; convert it"
            )
        turned = bool(hint)
        width, height = size[::-1] if turned else size
        if abs(width * camera.size[1] / (height * camera.size[0]) - 1) > 0.02:
            raise DataError(
                f"{path}: {width} x {height} pixels, but its camera is for {camera.size[0]:.0f} x "
                f"{camera.size[1]:.0f}; expected that shape: the photos that the poses were "
                "computed from, or smaller copies"
            )
        factor = min(1.0, self._side / max(width, height))
        return (max(1, round(width * factor)), max(1, round(height * factor))), turned

    def mask_of(self, path: Path, camera: Camera) -> Path | None:
        """File of the mask of a photo; None if all its pixels are valid. Raises DataError if the
        mask that its camera names is missing."""
        relative = PurePosixPath(camera.mask if "\0" not in camera.mask else "")
        if relative.name:
            mask = self._masks / relative
            # never opens files outside of the folder
            if relative.is_absolute() or ".." in relative.parts or not mask.is_file():
                raise DataError(
                    f"{mask}: no such mask, but the cameras name it; add the file, or remove its "
                    "name from the camera file"
                )
            return mask
        if self._folder is None:
            return None
        own = self._folder.absolute().parent / "masks" / path.relative_to(self._folder)
        names = (own.with_name(f"{own.name}.png"), own.with_suffix(".png"))
        return next((name for name in names if name.is_file()), None)

    def _mask(self, photo: Path, camera: Camera, size: tuple[int, int]) -> Tensor | None:
        """The mask of a photo, (H, W, 1) bool. White pixels are valid."""
        from PIL import Image

        path = self.mask_of(photo, camera)
        if path is None:
            return None
        try:
            with open_image(path) as opened:
                small = opened.convert("L").resize(size, Image.Resampling.BOX)
        except IMAGE_ERRORS as error:
            raise DataError(f"{path}: cannot be read as a mask ({one_line(error, 80)})") from error
        return torch.from_numpy(np.array(small)).ge(128)[..., None]

    def _map(
        self, path: Path, lens: Lens, K: Tensor, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        key = (lens, *K.flatten().tolist(), size)
        if key not in self._maps:
            places, shown = pixel_map(lens, K, *size)
            if float(shown.double().mean()) < 0.1:
                raise DataError(
                    f"{path}: undistorting it with its camera's lens leaves no pixels; check the "
                    "distortion coefficients"
                )
            if len(self._maps) >= 8:  # if each photo has its own lens, none is reused
                self._maps.pop(next(iter(self._maps)))
            self._maps[key] = places, shown[..., None]
        return self._maps[key]


def _sampled(image: Tensor, places: Tensor) -> Tensor:
    """An image (H, W, C) sampled at places (h, w, 2), bilinear: (h, w, C) float32."""
    planes = image.permute(2, 0, 1)[None].float()
    return F.grid_sample(planes, places[None], padding_mode="border", align_corners=False)[
        0
    ].permute(1, 2, 0)
