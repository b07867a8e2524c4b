"""A trained run as a scene: its Gaussians, and its photos and poses in the frame that it was
trained in."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.utils.colors import get_color
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.nerfstudio_plugin.cameras import VIEWER_BACKGROUND, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.frames import Frames, MemoryCache, UndistortedDataset
from pointsplat_ns.nerfstudio_plugin.image_guard import photos_alone
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene, Split
from pointsplat_ns.pipeline.photos.examples import Example
from pointsplat_ns.scene.checkpoints import read_checkpoint, read_photo_fit
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.inert_yaml import Tagged
from pointsplat_ns.scene.runs import RUN_FILES, Run
from pointsplat_ns.scene.usable import keep_usable
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.files import one_line
from pointsplat_ns.system.tensors import FLOATS

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig


def dataparser_of(run: Run) -> DataParser:
    """The dataparser that a run was trained with, with the same settings; those that it does not
    know are logged. Its name is looked up among the classes that nerfstudio or an installed plugin
    registers, and is never imported. Raises SceneError if it is not there."""
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    classes = {
        f"{type(c).__module__}.{type(c).__qualname__}": type(c) for c in all_dataparsers.values()
    }
    name = run.dataparser_class
    if name not in classes:
        raise SceneError(
            f"{run.config_path}: trained with the dataparser {name or 'of another kind'}, which is "
            "not installed here; install the plugin that provides it"
        )
    config = classes[name]()
    fields = {f.name for f in dataclasses.fields(config)}
    unknown = [
        name
        for name, value in run.dataparser_fields.items()
        if name not in fields and value is not None
    ]
    if unknown:
        log(
            f"{run.config_path}: settings that its dataparser no longer has are left out: "
            f"{', '.join(unknown)}"
        )
    for field_name, value in run.dataparser_fields.items():
        if field_name in fields and not isinstance(
            value, Tagged
        ):  # of a Python object, the default is kept
            # Seed points are not needed.
            setattr(
                config,
                field_name,
                False if field_name in ("load_seed_points", "load_3D_points") else value,
            )
    config.data = run.data
    return config.setup()


def corrected_poses(run: Run, poses: Tensor) -> Tensor:
    """Poses (C, 3, 4) of a run's training photos, camera-to-world in OpenGL axes, with the
    corrections in its checkpoint, if there are some, as nerfstudio's model applies them. Raises
    SceneError if the checkpoint is not usable, or the run does not say how it corrects poses;
    DataError if it corrected another number of them."""
    adjustments = read_photo_fit(run.checkpoint).adjustments
    if adjustments is None:
        return poses
    if len(adjustments) != len(poses):
        raise DataError(
            f"{run.data}: {len(poses)} training photos, but {run.checkpoint} corrects the poses of "
            f"{len(adjustments)}; put back the data as it was"
        )
    fields = (
        settings.get("camera_optimizer") for settings in (run.model_fields, run.datamanager_fields)
    )
    modes = [field.fields.get("mode") for field in fields if isinstance(field, Tagged)]
    mode = next((mode for mode in modes if mode in ("SO3xR3", "SE3")), None)
    if mode is None:
        raise SceneError(
            f"{run.config_path}: its camera optimizer has the mode {next(iter(modes), None)!r}, "
            f"but {run.checkpoint} "
            "holds corrected poses; expected SO3xR3 or SE3; put back the config.yml of the run"
        )
    optimizer: CameraOptimizer = CameraOptimizerConfig(mode=mode).setup(
        num_cameras=len(poses), device="cpu"
    )
    optimizer.pose_adjustment.data = adjustments
    with torch.no_grad():
        motions = optimizer.get_correction_matrices().to(poses)
    # Rotations are about the camera's own position, translations in world axes.
    return torch.cat(
        [motions[:, :, :3] @ poses[:, :, :3], poses[:, :, 3:] + motions[:, :, 3:]], dim=2
    )


class TrainedScene(DenseScene):
    """One trained run: its Gaussians and its posed photos, both read when they are needed.
    Arguments are those of :class:`DenseScene`; ``has_photos`` says whether the run's data was
    found."""

    def __init__(
        self,
        name: str,
        run: Run,
        cache: MemoryCache,
        poses: ScenesDataManagerConfig | None = None,
        device: torch.device | str = "cpu",
        has_photos: bool = True,
    ):
        super().__init__(name, run.checkpoint, cache, poses, device)
        self.run = run
        self.has_photos = has_photos
        self.rasterize_mode = run.rasterize_mode
        self._photos: dict[Split, Frames] = {}

    @cached_property
    def identity(self) -> str:
        """EXPERIMENT/METHOD/TIME and the step: a scene that is trained again has another one. Its
        content does not count."""
        run = self.run
        return f"{self.name}/{run.method_name}/{run.timestamp} step {run.step}"

    def read_dense(self) -> Gaussians:
        """Read the Gaussians from the checkpoint, onto the CPU."""
        return keep_usable(read_checkpoint(self.run.checkpoint), self.run.checkpoint)

    @property
    def background(self) -> Tensor:
        """Background colour (3,), in [0, 1], that the run is evaluated with."""
        color = self.run.model_fields.get("background_color")
        return (
            get_color(color)
            if color in ("black", "white")
            else torch.tensor(VIEWER_BACKGROUND, **FLOATS)
        )

    @cached_property
    def _dataparser(self) -> DataParser:
        return dataparser_of(self.run)

    def _outputs(self, split: str) -> DataparserOutputs:
        """The dataparser's outputs for a split. Raises DataError if the data is damaged, or its
        coordinate frame is not that of the Gaussians."""
        try:
            with photos_alone():
                outputs = self._dataparser.get_dataparser_outputs(split=split)
        except PointSplatError as error:
            raise type(error)(f"{error} (read as the data of {self.run.folder})") from error
        except (
            Exception
        ) as error:  # nerfstudio's parsers check little: a damaged file can raise nearly anything
            why = f"{type(error).__name__}: {one_line(error)}"
            raise DataError(
                f"{self.run.data}: cannot be read as the data of {self.run.folder} ({why}); put "
                "back the data as it was"
            ) from error
        moved = (outputs.dataparser_transform[:3] - self.run.transform).abs().max()
        kept = self.run.folder / RUN_FILES.transforms
        if moved > 1e-4 or abs(outputs.dataparser_scale / self.run.scale - 1) > 1e-4:
            if not kept.is_file():
                raise DataError(
                    f"{kept}: no such file, so the frame of the scene is not known; put back the "
                    "file"
                )
            raise DataError(
                f"{self.run.data}: its poses are no longer in the frame that {self.run.folder} was "
                f"trained in (the transform differs by {float(moved):.3g}, the scale is "
                f"{outputs.dataparser_scale:.6g} and was {self.run.scale:.6g}); put back the data "
                "as it was, or train the scene again"
            )
        return outputs

    def frames(self, split: Split) -> Frames:
        """Photos at the run's training resolution, those of training in the poses as it corrected
        them; without data the scene's own renders."""
        if not self.has_photos:
            return self.rendered[split]
        if split not in self._photos:
            scale = self.run.datamanager_fields.get("camera_res_scale_factor", 1.0)
            scale = float(scale) if isinstance(scale, (int, float)) else 1.0
            dataset = UndistortedDataset(self._outputs(split), scale)
            if split == "train":
                dataset.cameras.camera_to_worlds = corrected_poses(
                    self.run, dataset.cameras.camera_to_worlds
                )
            self._photos[split] = Frames(dataset, cache=self.cache, device=self.device)
        return self._photos[split]

    def cameras(self, split: Split) -> Cameras:
        """The dataset's cameras, or sampled ones if the data is missing."""
        return self.frames(split).dataset.cameras if self.has_photos else super().cameras(split)

    def views(self, split: Split) -> Views:
        """The poses of a split, on the CPU. Raises DataError if there is none, or they are not
        usable."""
        cameras = self.cameras(split)
        if len(cameras) == 0:
            raise DataError(f"{self.run.data}: no pose in the {split} split; expected at least one")
        try:
            views = views_of_cameras(cameras, self.background, self.rasterize_mode)
        except DataError as error:
            raise DataError(f"{self.run.data}: {error}") from error
        return dataclasses.replace(
            views, viewmats=views.viewmats.detach().cpu(), Ks=views.Ks.detach().cpu()
        )

    def photos(self, split: Split) -> RunPhotos:
        """The photos of a split, read when they are asked for. Raises DataError as
        :meth:`views`."""
        self.views(split)
        return RunPhotos(self, self.frames(split))

    def need_photos_as_rendered(self, instead: str) -> None:
        """Raise a DataError, with the advice ``instead``, if the training fitted colours to each of
        its photos, which renders of the scene do not have: by a bilateral grid, or an embedding of
        appearance."""
        colors = read_photo_fit(self.run.checkpoint).colors
        if colors:
            raise DataError(
                f"{self.run.checkpoint}: holds {colors}, which fits colours to each training "
                "photo; renders of the "
                f"scene do not have them, so its training photos cannot be used; {instead}"
            )


class RunPhotos(Sequence[Example]):
    """Photos of a split, and the views on the CPU that they show once undistorted."""

    def __init__(self, scene: TrainedScene, frames: Frames):
        self._scene = scene
        self._frames = frames
        self._views: dict[int, View] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __repr__(self) -> str:
        return f"RunPhotos({len(self)} photos of {self._scene.name})"

    def __getitem__(self, index: int) -> Example:  # type: ignore[override]
        view = self._views.get(index)
        if view is None:
            camera = self._frames.camera(index)
            view = self._views[index] = views_of_cameras(
                camera, self._scene.background, self._scene.rasterize_mode
            )[0]
        data = self._frames.data(index)
        return Example(view, data["image"][..., :3], data.get("mask"))
