"""Reads a scene with views from a camera file, and checks that both have the same frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.pipeline.options import NO_POSES
from pointsplat_ns.pipeline.photos.pose_check import POSE_CHECK, Photo, likeness, pose_faults
from pointsplat_ns.scene.camera_files import (
    NamedViews,
    camera_files_near,
    read_named_views,
    transforms_beside,
)
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import read_reduced
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.runs import RUN_FILES, may_be_run
from pointsplat_ns.scene.views import Views, spread_indices
from pointsplat_ns.system.files import logger


def without_poses(poses: object) -> bool:
    """Whether ``poses`` is :data:`NO_POSES`."""
    return isinstance(poses, (str, Path)) and str(poses) == NO_POSES


def poses_nearby(path: Path, scene: Gaussians) -> PosesFile | None:
    """Views from a camera file beside a scene's file or above it, see
    :func:`~pointsplat_ns.scene.camera_files.camera_files_near`; None if no camera file belongs to
    the scene.

    The file is logged in one line. It is used if its views show the scene sharp, and its poses are
    in the scene's frame: written by the training, or moved by ``dataparser_transforms.json``. The
    user did not name the file, so its photos are not opened.
    """
    for place in camera_files_near(path):
        try:
            found = PosesFile.of(path, place).relative_to(scene.offset)
            if found.named.in_scene_frame or found.transforms is not None:
                found.check(scene, photos=False)
                logger.info("poses: %s; --poses none samples views instead", place)
                return found
            reason = f"its frame may differ; --poses {place} uses it after comparing its photos"
        except (DataError, SceneError) as error:
            reason = str(error)
        logger.info("%s: not used for views: %s", place, reason)
    return None


def read_scene_and_cameras(
    scene: Gaussians | Path | str, poses: Path | str | None
) -> tuple[Gaussians, Views | None, Path | None]:
    """Read a scene, views from a given or nearby camera file, and the path of that file. A given
    file is read before the scene, then checked against it. Raises the errors of
    :meth:`PosesFile.of`, :func:`~pointsplat_ns.scene.read_scene` and :meth:`PosesFile.check`."""
    if poses is not None and not without_poses(poses):
        given = PosesFile.of(scene, poses)
        dense = scene if isinstance(scene, Gaussians) else read_scene(scene)
        given = given.relative_to(dense.offset)
        given.check(dense)
        return dense, given.views, given.path
    if isinstance(scene, Gaussians):
        return scene, None, None
    path = Path(scene)
    dense = read_scene(path)
    looked_for = poses is None and path.is_file() and not may_be_run(path)
    found = poses_nearby(path, dense) if looked_for else None
    return (dense, None, None) if found is None else (dense, found.views, found.path)


@dataclass(frozen=True, eq=False)
class PosesFile:
    """Views of a scene from a camera file."""

    path: Path
    views: Views
    """Views in the frame of the scene's file, or relative to its offset; at most 1600 pixels on the
    longer side, as in 3DGS training."""
    named: NamedViews
    transforms: Path | None
    """File with the transform from the dataset's frame to the scene's; None if there is none."""

    @staticmethod
    def of(scene: Gaussians | Path | str, poses: Path | str) -> PosesFile:
        """Read the views of a scene from a camera file.

        A ``dataparser_transforms.json`` in the scene's run, beside the scene or beside the poses
        moves views into the scene's frame. Raises SceneError if a file is missing or the transforms
        are unusable, and DataError if there is no usable camera.
        """
        transforms = None if isinstance(scene, Gaussians) else _transforms_of(Path(scene))
        transforms = transforms or transforms_beside(poses)
        named = read_named_views(poses, transforms)
        return PosesFile(Path(poses), named.views.resized(1600), named, transforms)

    def relative_to(self, offset: tuple[float, float, float] | None) -> PosesFile:
        """The same with views relative to a scene's offset, scene units."""
        return replace(self, views=self.views.relative_to(offset))

    def check(self, scene: Gaussians, photos: bool = True) -> None:
        """Check that the views, relative to the scene's offset, belong to a scene: by small renders
        and, if ``photos``, by photos at the paths in the file.

        Raises:
            DataError: if most views show nothing of the scene or nothing sharp, or renders do not
                match the photos. An invisible scene passes.
        """
        faults = pose_faults(scene, self.views)
        like = None if faults.serious or not photos else likeness(scene, self._photos())
        if not faults.serious and (like is None or like.enough):
            return
        mend = (
            "nerfstudio moves and scales scenes; put dataparser_transforms.json of its run beside "
            "the scene, or write the scene in the frame of its data (pointsplat convert RUN "
            "--original-frame)"
        )
        if self.transforms is not None:
            mend = (
                f"{self.transforms} belongs to another run, or the scene was moved since training; "
                "write the scene again from its run"
            )
        raise DataError(
            f"{self.path}: {faults if like is None else like}; poses and scene are probably in "
            f"different frames: {mend}"
        )

    def _photos(self) -> list[Photo]:
        """Photos of some views, if they exist at the paths in the file and have the view's aspect
        ratio."""
        found: list[Photo] = []
        for index in spread_indices(len(self.views), POSE_CHECK.views):
            file = self.named.photo(index)
            view = self.views[index]
            photo = None if file is None else read_reduced(file, POSE_CHECK.side)
            if photo is None:
                continue
            # Another aspect ratio means that the photo is cropped, or rotated by EXIF.
            aspect_ratio = photo.shape[1] * view.height / (photo.shape[0] * view.width)
            if abs(aspect_ratio - 1) < 0.05:
                found.append((view, photo, None))
        return found


def check_photos(scene: Gaussians, photos: Sequence[Photo], data: Path | str) -> None:
    """Raise a DataError if renders of a scene do not match a few of its training photos; ``data``
    is their path."""
    some = [photos[index] for index in spread_indices(len(photos), POSE_CHECK.views)]
    like = likeness(scene, some)
    if not like.enough:
        raise DataError(
            f"{data}: {like}; the photos or their poses are probably not those of the training: "
            "put back the data as it was, or name the folder where it is now (--data DIR)"
        )


def _transforms_of(scene: Path) -> Path | None:
    """The ``dataparser_transforms.json`` in the scene's run, or beside its file."""
    folder = scene if scene.is_dir() else scene.parent
    if scene.suffix == ".ckpt" and not (folder / RUN_FILES.config).is_file():
        folder = folder.parent
    return transforms_beside(folder / RUN_FILES.config)
