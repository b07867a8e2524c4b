"""The trained scenes, with their posed photos, that the refiner is trained and evaluated on.

A trained run names its data, its dataparser and its coordinate frame. So ``--data`` takes just a run, or any folder
above several. If the training targets are renders of the dense scenes, photos are not needed, and ``--data`` may also
name PLY files.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.discovery import Supervision, find_runs_and_plys
from pointsplat_ns.io.files import one_line
from pointsplat_ns.io.inert_yaml import Tagged
from pointsplat_ns.io.runs import RUN_FILES, Run, open_run
from pointsplat_ns.io.splatfacto import read_checkpoint, read_photo_fit
from pointsplat_ns.io.usable import keep_usable
from pointsplat_ns.nerfstudio_plugin.cameras import VIEWER_BACKGROUND
from pointsplat_ns.nerfstudio_plugin.frames import Frames, MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene, SampledPoses, Split
from pointsplat_ns.nerfstudio_plugin.undistorted import UndistortedDataset
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.views import RasterizeMode


def dataparser_of(run: Run) -> DataParser:
    """The dataparser that a run was trained with, with the same settings.

    Only classes that nerfstudio or an installed plugin registers are used: the name in the run's file is looked up
    among them and is never imported. A setting that it does not know is left out, with a line in the log. Raises
    SceneError if the dataparser is not installed.
    """
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    classes = {f"{type(c).__module__}.{type(c).__qualname__}": type(c) for c in all_dataparsers.values()}
    name = run.dataparser_class
    if name not in classes:
        raise SceneError(
            f"{run.config_path}: trained with the dataparser {name or 'of another kind'}, which is not "
            "installed here; install the plugin that provides it"
        )
    config = classes[name]()
    fields = {f.name for f in dataclasses.fields(config)}
    unknown = [name for name, value in run.dataparser_fields.items() if name not in fields and value is not None]
    if unknown:
        CONSOLE.log(f"{run.config_path}: settings that its dataparser no longer has are left out: {', '.join(unknown)}")
    for field_name, value in run.dataparser_fields.items():
        if field_name in fields and not isinstance(value, Tagged):  # of a Python object, the default is kept
            # Seed points are not needed.
            setattr(config, field_name, False if field_name in ("load_seed_points", "load_3D_points") else value)
    config.data = run.data
    return config.setup()


def corrected_poses(run: Run, poses: Tensor) -> Tensor:
    """Poses of a run's training photos with the corrections in its checkpoint, as nerfstudio's model applies them.

    Args:
        run: a Splatfacto run.
        poses: (C, 3, 4) camera to world, OpenGL axes, in the order of the training split.

    Returns:
        (C, 3, 4); ``poses`` itself if the training corrected none.

    Raises:
        SceneError: if the checkpoint is not usable, or the run does not say how it corrects poses.
        DataError: if the dataset has another number of training photos than were corrected.
    """
    adjustments = read_photo_fit(run.checkpoint).adjustments
    if adjustments is None:
        return poses
    if len(adjustments) != len(poses):
        raise DataError(
            f"{run.data}: {len(poses)} training photos, but {run.checkpoint} corrects the poses of "
            f"{len(adjustments)}; put back the data as it was"
        )
    fields = (settings.get("camera_optimizer") for settings in (run.model_fields, run.datamanager_fields))
    modes = [field.fields.get("mode") for field in fields if isinstance(field, Tagged)]
    mode = next((mode for mode in modes if mode in ("SO3xR3", "SE3")), None)
    if mode is None:
        raise SceneError(
            f"{run.config_path}: its camera optimizer has the mode {next(iter(modes), None)!r}, but {run.checkpoint} "
            "holds corrected poses; expected SO3xR3 or SE3; put back the config.yml of the run"
        )
    optimizer: CameraOptimizer = CameraOptimizerConfig(mode=mode).setup(num_cameras=len(poses), device="cpu")
    optimizer.pose_adjustment.data = adjustments
    with torch.no_grad():
        motions = optimizer.get_correction_matrices().to(poses)
    # Rotations are about the camera's own position, translations in world axes.
    return torch.cat([motions[:, :, :3] @ poses[:, :, :3], poses[:, :, 3:] + motions[:, :, 3:]], dim=2)


def need_photos_as_rendered(run: Run, instead: str) -> None:
    """Raise a DataError, with the advice ``instead``, if the training fitted colours to each of its photos: a bilateral
    grid, or an embedding of appearance. Renders of the scene then do not have the colours of the photos."""
    colors = read_photo_fit(run.checkpoint).colors
    if colors:
        raise DataError(
            f"{run.checkpoint}: holds {colors}, which fits colours to each training photo; renders of the scene do not "
            f"have them, so its training photos cannot be used; {instead}"
        )


class TrainedScene(DenseScene):
    """One trained run: its Gaussians and its posed photos, both read when they are needed. Arguments are those of
    :class:`DenseScene`; ``has_photos`` says whether the run's data was found."""

    def __init__(
        self,
        name: str,
        run: Run,
        cache: MemoryCache,
        poses: SampledPoses | None = None,
        device: torch.device | str = "cpu",
        has_photos: bool = True,
    ):
        super().__init__(name, run.checkpoint, cache, poses, device)
        self.run = run
        self.has_photos = has_photos

    @cached_property
    def identity(self) -> str:
        """EXPERIMENT/METHOD/TIME and the step. A scene that is trained again has another time, and so another identity.

        The content does not count: a scene that replaces one of the same name, time and step is taken to show the same
        place, so the network has been trained on it.
        """
        run = self.run
        return f"{self.name}/{run.method_name}/{run.timestamp} step {run.step}"

    def read_dense(self) -> Gaussians:
        """Read the Gaussians from the checkpoint, onto the CPU."""
        return keep_usable(read_checkpoint(self.run.checkpoint), self.run.checkpoint)

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """The run's rasterize mode."""
        return self.run.rasterize_mode

    @property
    def background(self) -> Tensor:
        """Background colour (3,), in [0, 1], that the run is evaluated with."""
        color = self.run.model_fields.get("background_color")
        return get_color(color) if color in ("black", "white") else torch.tensor(VIEWER_BACKGROUND, **FLOATS)

    @cached_property
    def _dataparser(self) -> DataParser:
        return dataparser_of(self.run)

    def _outputs(self, split: str) -> DataparserOutputs:
        """The dataparser's outputs for a split. Raises DataError if the data is damaged, or its coordinate frame is not
        that of the Gaussians."""
        try:
            outputs = self._dataparser.get_dataparser_outputs(split=split)
        except PointSplatError:
            raise
        except Exception as error:  # nerfstudio's parsers check little: a damaged file can raise nearly anything
            why = f"{type(error).__name__}: {one_line(error)}"
            raise DataError(
                f"{self.run.data}: cannot be read as the data of {self.run.folder} ({why}); put back the data as it was"
            ) from error
        moved = (outputs.dataparser_transform[:3] - self.run.transform).abs().max()
        kept = self.run.folder / RUN_FILES.transforms
        if moved > 1e-4 or abs(outputs.dataparser_scale / self.run.scale - 1) > 1e-4:
            if not kept.is_file():
                raise DataError(f"{kept}: no such file, so the frame of the scene is not known; put back the file")
            raise DataError(
                f"{self.run.data}: its poses are no longer in the frame that {self.run.folder} was trained in (the "
                f"transform differs by {float(moved):.3g}, the scale is {outputs.dataparser_scale:.6g} and was "
                f"{self.run.scale:.6g}); put back the data as it was, or train the scene again"
            )
        return outputs

    def _frames(self, split: str) -> Frames:
        scale = self.run.datamanager_fields.get("camera_res_scale_factor", 1.0)
        scale = float(scale) if isinstance(scale, (int, float)) else 1.0
        dataset = UndistortedDataset(self._outputs(split), scale)
        if split == "train":
            dataset.cameras.camera_to_worlds = corrected_poses(self.run, dataset.cameras.camera_to_worlds)
        return Frames(dataset, cache=self.cache, device=self._device)

    @cached_property
    def train_frames(self) -> Any:
        """Training photos at the run's training resolution, in the poses as the training corrected them; without data
        the scene's own renders."""
        return self._frames("train") if self.has_photos else self.rendered_train

    @cached_property
    def eval_frames(self) -> Any:
        """Held-out photos at the run's training resolution, or without data the scene's own renders."""
        return self._frames("test") if self.has_photos else self.rendered_eval

    def cameras(self, split: Split) -> Cameras:
        """The dataset's cameras, or sampled ones if the data is missing."""
        if not self.has_photos:
            return super().cameras(split)
        return (self.train_frames if split == "train" else self.eval_frames).dataset.cameras


def training_scenes(
    folder: Path,
    supervision: Supervision,
    cache: MemoryCache,
    poses: SampledPoses | None = None,
    device: torch.device | str = "cpu",
    need_data: bool = True,
    data: Path | None = None,
) -> tuple[Literal["photos", "dense"], list[DenseScene]]:
    """The scenes that ``--data`` names, and the kind of their training targets.

    Args:
        folder: a run, a PLY file, or any folder above several.
        supervision: ``photos`` takes the runs whose data is found, and names the others; ``dense`` takes the runs, with
            or without their data, and the PLY files; ``auto`` is ``photos`` if there is a run, ``dense`` otherwise.
        cache, poses, device: passed to the scenes.
        need_data: whether photos will be needed.
        data: where the data of the runs is now, as for :func:`~pointsplat_ns.io.runs.open_run`.

    Raises:
        SceneError: if there is no scene, or photos are needed and those of no run are found.
        DataError: if photos are needed whose colours a training fitted to each.
    """
    runs, plys, nothing = find_runs_and_plys(folder, supervision)
    if not runs and not plys:
        if nothing is None:
            found = "a PLY file, which has no photos" if supervision == "photos" else "no Gaussians in it"
            found = found if folder.is_file() else "no such file"
            wanted = "--pipeline.datamanager.supervision dense" if supervision == "photos" else "a 3DGS .ply"
            raise SceneError(f"{folder}: {found}; expected {wanted}")
        hint = " (PLY files are trained on with --pipeline.datamanager.supervision dense)"
        raise SceneError(f"{nothing}{hint if supervision == 'photos' else ', or 3DGS PLY files'}") from nothing
    chosen: Literal["photos", "dense"] = "dense" if plys or supervision == "dense" else "photos"
    scenes: list[DenseScene] = []
    missing: list[str] = []
    for name, run in runs.items():
        has_photos = True
        if need_data:
            try:
                run = dataclasses.replace(run, data=open_run(run.config_path, data=data).data)
            except SceneError:
                has_photos = False
                missing.append(f"{run.config_path}: its data {run.data} is not there")
                what = "left out" if chosen == "photos" else "seen from sampled poses"
                CONSOLE.log(f"{name} is {what}: {missing[-1]}")
            if has_photos and chosen == "photos":
                need_photos_as_rendered(run, "take --pipeline.datamanager.supervision dense")
        if has_photos or chosen == "dense":
            scenes.append(TrainedScene(name, run, cache, poses, device, has_photos))
    scenes += [DenseScene(name, path, cache, poses, device) for name, path in plys.items()]
    if not scenes:
        others = f", and that of {len(missing) - 1} more runs" if missing[1:] else ""
        raise SceneError(
            f"{missing[0]}{others}; name the folder where it is now (--pipeline.datamanager.scene-data DIR), or take "
            "--pipeline.datamanager.supervision dense"
        )
    return chosen, scenes
