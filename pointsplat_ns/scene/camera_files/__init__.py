"""Readers of camera files: poses and intrinsics in COLMAP's, nerfstudio's and INRIA's formats.

Camera files are untrusted: sizes are limited, and errors are one line.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.errors import DataError
from pointsplat_ns.scene.camera_files.camera_views import (
    Camera,
    CameraFile,
    Motion,
    checked_views,
    photo_file,
    photo_order,
    rigid,
)
from pointsplat_ns.scene.camera_files.colmap import colmap_cameras, model_folder
from pointsplat_ns.scene.camera_files.json_cameras import (
    inria_cameras,
    nerfstudio_cameras,
    photo_folders,
)
from pointsplat_ns.scene.formats import SOG_META, STREAM_META, format_named
from pointsplat_ns.scene.runs import RUN_FILES, may_be_run, read_transforms
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.files import logger, one_line, require_file, require_memory
from pointsplat_ns.system.opening import open_regular

CAMERA_KINDS = (
    "cameras.json of 3DGS, transforms.json of nerfstudio, or the folder of a COLMAP model or "
    "project"
)


@dataclass(frozen=True, eq=False)
class NamedViews:
    """Views of a camera file, and the folders of their photos."""

    views: Views
    """float64 on the CPU, black background, ordered by photo name."""
    folders: Sequence[Path]
    """Folders searched for photos: the file's own, ScanNet++'s photo folder, or ``images`` of the
    COLMAP project."""
    cameras: Sequence[Camera]
    """As read from the file, in the order of the views."""
    saved: Motion | None
    """Transform already applied to the dataset's world, see :class:`~cameras.CameraFile`."""
    motion: Motion | None
    """File whose transform moved the poses into the scene frame; None if none did."""

    @property
    def names(self) -> list[str]:
        """Photo name of each view, as written in the file; empty if it has none."""
        return [camera.name for camera in self.cameras]

    @property
    def in_scene_frame(self) -> bool:
        """Whether the file format defines its poses in the frame of a trained scene."""
        return self.saved is None

    def photo(self, index: int) -> Path | None:
        """The photo of a view; None if it is not in or below one of the folders."""
        return photo_file(self.folders, self.names[index])


def is_camera_file(path: Path | str) -> bool:
    """Whether a path can only be a camera file, because it is neither a run nor a scene. Does not
    read the file."""
    path = Path(path)
    if path.is_dir():
        return model_folder(path) is not None or not any(
            (path / name).is_file() for name in (RUN_FILES.config, SOG_META, STREAM_META)
        )
    return not may_be_run(path) and format_named(path.name) is None


def camera_files_near(scene: Path) -> list[Path]:
    """Camera files and COLMAP projects at the usual places near a scene: beside the file, in the
    3DGS training folder above ``point_cloud/iteration_N``, and the COLMAP project that contains the
    file or its folder."""
    folder = scene.absolute().parent
    roots = [folder.parents[1]] if folder.parent.name == "point_cloud" else []
    files = [root / "cameras.json" for root in (*roots, folder)]
    files.append(folder / "transforms.json")
    return [
        *filter(Path.is_file, files),
        *(place for place in (folder, folder.parent) if model_folder(place)),
    ]


def transforms_beside(path: Path | str) -> Path | None:
    """The ``dataparser_transforms.json`` in a folder, or beside a path; None if there is none."""
    path = Path(path)
    places = (path / RUN_FILES.transforms, path.parent / RUN_FILES.transforms)
    return next((place for place in places if place.is_file()), None)


def read_named_views(path: Path | str, transforms: Path | None = None) -> NamedViews:
    """Read the cameras of a file.

    Lens distortion is ignored; a warning is logged. Each view has the image size of its camera.

    Args:
        path: INRIA's ``cameras.json``, nerfstudio's ``transforms.json`` or its folder, or the
            folder of a COLMAP model or project.
        transforms: the ``dataparser_transforms.json`` of the scene's run. It moves poses of
            ``transforms.json`` and of COLMAP into the scene frame. By default the one beside
            ``path``, if there is one. Poses of ``cameras.json`` are already in the scene frame.

    Raises:
        SceneError: if the file is missing, or the transforms are not usable.
        DataError: if the file has another format, is too large or damaged, or has an unusable
            camera.

    Example:
        >>> import json, tempfile, torch
        >>> frames = [{"file_path": "a.png", "transform_matrix": torch.eye(4).tolist()}]
        >>> content = {"fl_x": 50, "w": 64, "h": 48, "frames": frames}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "transforms.json")
        ...     _ = path.write_text(json.dumps(content))
        ...     views = read_named_views(path).views
        >>> len(views), views.width, views.height
        (1, 64, 48)
    """
    path = Path(path)
    model = model_folder(path)
    if model is None and (path / "transforms.json").is_file():
        path /= "transforms.json"
    found = _json_cameras(path) if model is None else colmap_cameras(path)
    if bent := sum(camera.bent for camera in found.cameras):
        logger.info(
            "%s: the lens distortion of %d of %d cameras is ignored", path, bent, len(found.cameras)
        )
    folders = photo_folders(path)
    if model is not None:
        folders = [above / "images" for above in (model, *model.absolute().parents[:3])]
    motion = None
    transforms = transforms or transforms_beside(path)
    if found.saved is not None and transforms is not None:
        transform, scale = read_transforms(transforms)
        exact = rigid(transform.double()[None], f"{transforms}: its transform")[0]
        logger.info("%s: poses moved into the frame of the scene by %s", path, transforms)
        motion = found.saved.undone_before(Motion(exact, scale))
    order = photo_order([camera.name for camera in found.cameras])
    views = checked_views(path, found.cameras, motion)[order]
    return NamedViews(
        views, folders, [found.cameras[index] for index in order], found.saved, motion
    )


def _json_cameras(path: Path) -> CameraFile:
    """The cameras of a JSON file: a list is INRIA's, an object with ``frames`` nerfstudio's."""
    if path.is_dir():
        raise DataError(
            f"{path}: no cameras.bin or cameras.txt in the folder or its sparse/0; expected "
            f"{CAMERA_KINDS}"
        )
    path = require_file(path, CAMERA_KINDS)
    # about the size of 100,000 frames
    size = path.stat().st_size
    most = 64_000_000
    if size > most:
        raise DataError(
            f"{path}: {size / 1e6:.0f} MB; expected cameras of at most {most / 1e6:.0f} MB"
        )
    require_memory(path, 24 * size)  # worst case of memory per byte of JSON: empty lists
    try:
        with open_regular(path) as stream:
            content = json.loads(stream.read())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{path}: cannot be read as JSON ({one_line(error, 80)}); expected {CAMERA_KINDS}"
        ) from error
    if isinstance(content, list):
        if content and isinstance(content[0], dict) and "transform" in content[0]:
            raise DataError(
                f"{path}: poses of `ns-export cameras`, without sizes and focal lengths; name the "
                "run itself, or the transforms.json or COLMAP project of its data with the run's "
                f"{RUN_FILES.transforms} beside it"
            )
        return inria_cameras(content, path)
    if isinstance(content, dict) and isinstance(content.get("frames"), list):
        return nerfstudio_cameras(content, path)
    if isinstance(content, dict) and "camera_path" in content:
        raise DataError(f"{path}: camera path of `ns-render`; expected {CAMERA_KINDS}")
    raise DataError(f"{path}: JSON without a list of cameras; expected {CAMERA_KINDS}")
