"""Trained scenes with their posed photos, one or many, as the refiner is trained and evaluated on.

A trained run knows its data, its dataparser and its frame, so the run is all that a person names:
``--data`` takes one run, or any folder above several. Photos are not needed where the dense scene's own
renders are what the refiner learns from: ``--data`` may then name PLY files, too.
"""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.base_datamanager import DataManager, DataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.colors import get_color
from nerfstudio.utils.rich_utils import CONSOLE

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.discovery import Supervision, find_runs_and_plys
from pointsplat_ns.io.inert_yaml import Tagged
from pointsplat_ns.io.runs import Run, open_run, shown_scene
from pointsplat_ns.io.splatfacto import read_checkpoint
from pointsplat_ns.nerfstudio_plugin.frames import FrameCache, Frames, free_memory_share, to_device
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene, PlyScene, SampledPoses, Split

VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""What Splatfacto evaluates over where it trained with random backgrounds."""

_NO_SEEDS = ("load_seed_points", "load_3D_points")
"""Settings of dataparsers that gather seed points, which a trained scene has no use for."""


_FORMER_DATAPARSERS = {
    "pointsplat_ns.data.replica.ReplicaDataParserConfig": (
        "pointsplat_ns.nerfstudio_plugin.replica.dataparser.ReplicaDataParserConfig"
    ),
}
"""What runs of earlier versions call a dataparser, and what it is called today."""


def dataparser_of(run: Run) -> DataParser:
    """The dataparser that a run was trained with, set up as it was then.

    Only classes that nerfstudio or an installed plugin registers are used; the run's file names one,
    it does not get to import anything.

    Raises:
        SceneError: if the dataparser is not installed or does not know a setting.
    """
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    known = {f"{type(c).__module__}.{type(c).__qualname__}": type(c) for c in all_dataparsers.values()}
    name = _FORMER_DATAPARSERS.get(run.dataparser_class, run.dataparser_class)
    if name not in known:
        raise SceneError(
            f"{run.config_path}: trained with the dataparser {run.dataparser_class or 'of another kind'}, which is not "
            "installed here; install the plugin that provides it"
        )
    config = known[name]()
    fields = {f.name for f in dataclasses.fields(config)}
    for field_name, value in run.dataparser_fields.items():
        if field_name not in fields:
            raise SceneError(
                f"{run.config_path}: its dataparser has no setting {field_name!r}; install the version it had"
            )
        if isinstance(value, Tagged):
            continue  # an object: the default stands
        setattr(config, field_name, False if field_name in _NO_SEEDS else value)
    config.data = run.data
    return config.setup()


class TrainedScene(DenseScene):
    """One trained run: its Gaussians and, when asked for, its posed photos.

    Args:
        name: unique among the scenes in use.
        run: where everything is.
        cache: for decoded photos, Gaussians and renders, shared among scenes.
        poses: how to sample poses if the data is gone.
        device: where the dense scene's own renders are drawn.
        has_photos: whether the run's data is at hand.
    """

    def __init__(
        self,
        name: str,
        run: Run,
        cache: FrameCache,
        poses: SampledPoses | None = None,
        device: torch.device | str = "cpu",
        has_photos: bool = True,
    ):
        super().__init__(name, run.checkpoint, cache, poses, device)
        self.run = run
        self.has_photos = has_photos

    @property
    def identity(self) -> str:
        """Tells this trained scene from any other, wherever its folder is moved: EXPERIMENT/METHOD/TIME, step."""
        run = self.run
        return f"{self.name}/{run.method_name}/{run.timestamp} step {run.step}"

    def read_dense(self) -> Gaussians:
        """The Gaussians as trained, read anew each time: a dense scene is too big to keep many of."""
        return read_checkpoint(self.run.checkpoint)

    @property
    def rasterize_mode(self) -> Literal["classic", "antialiased"]:
        """How the run rendered, and how it is rendered from then on."""
        return self.run.rasterize_mode

    @property
    def background(self) -> torch.Tensor:
        """Colour (3,) that the run is evaluated over."""
        color = self.run.model_fields.get("background_color")
        return get_color(color) if color in ("black", "white") else torch.tensor(VIEWER_BACKGROUND)

    @cached_property
    def _dataparser(self) -> DataParser:
        return dataparser_of(self.run)

    def _outputs(self, split: str) -> DataparserOutputs:
        """What the dataparser says of the photos of a split.

        Raises:
            DataError: if their frame is not the one that the Gaussians are in.
        """
        outputs = self._dataparser.get_dataparser_outputs(split=split)
        moved = (outputs.dataparser_transform[:3] - self.run.transform).abs().max()
        if moved > 1e-4 or abs(outputs.dataparser_scale / self.run.scale - 1) > 1e-4:
            raise DataError(
                f"{self.run.data}: its poses are no longer in the frame that {self.run.folder} was trained in (the "
                f"transform differs by {float(moved):.3g}, the scale is {outputs.dataparser_scale:.6g} and was "
                f"{self.run.scale:.6g}); put back the data as it was, or train the scene again"
            )
        return outputs

    def _frames(self, split: str) -> Frames:
        scale = self.run.datamanager_fields.get("camera_res_scale_factor", 1.0)
        scale = float(scale) if isinstance(scale, (int, float)) else 1.0
        return Frames(InputDataset(self._outputs(split), scale), cache=self._cache)

    @cached_property
    def train_frames(self) -> Any:
        """Training photos at the resolution that the run was trained at; the scene's own renders without data."""
        return self._frames("train") if self.has_photos else self.rendered_train

    @cached_property
    def eval_frames(self) -> Any:
        """Held-out photos at the resolution that the run was trained at; the scene's own renders without data."""
        return self._frames("test") if self.has_photos else self.rendered_eval

    def cameras(self, split: Split) -> Cameras:
        """The dataset's cameras, or sampled ones if the data is gone."""
        if not self.has_photos:
            return super().cameras(split)
        return (self.train_frames if split == "train" else self.eval_frames).dataset.cameras


def find_scenes(
    folder: Path,
    supervision: Supervision,
    cache: FrameCache,
    poses: SampledPoses | None = None,
    device: torch.device | str = "cpu",
    need_data: bool = True,
) -> tuple[Literal["photos", "dense"], list[DenseScene]]:
    """The scenes that ``--data`` names, and what they are learned from.

    Args:
        folder: a run, a PLY file, or any folder above several.
        supervision: ``photos`` takes the runs, whose data must be at hand; ``dense`` takes the runs, whose data may be
            gone, and the PLY files; ``auto`` is ``photos`` if there is a run, ``dense`` otherwise.
        cache, poses, device: for the scenes.
        need_data: whether photos will be looked at.

    Raises:
        SceneError: if there is no scene, or a run's data is needed and not found.
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
    for name, run in runs.items():
        has_photos = True
        if need_data:
            try:
                run = dataclasses.replace(run, data=open_run(run.config_path).data)
            except SceneError as error:
                if chosen == "photos":
                    raise SceneError(f"{error}, or take --pipeline.datamanager.supervision dense") from error
                has_photos = False
        scenes.append(TrainedScene(name, run, cache, poses, device, has_photos))
    scenes += [PlyScene(name, path, cache, poses, device) for name, path in plys.items()]
    return chosen, scenes


@dataclass
class ScenesDataManagerConfig(DataManagerConfig):
    """Trained scenes with their posed photos"""

    _target: type = field(default_factory=lambda: ScenesDataManager)
    data: Path | None = None
    """A trained Splatfacto run, a 3DGS .ply, or a folder above several (the newest run of each experiment is taken)."""
    supervision: Supervision = "auto"
    """What renders of the refined scene are compared with in training: photos, or the dense scene's own renders, from
    the dataset's poses or, where there is no dataset, from poses sampled in free space. auto is photos for trained
    runs, and dense for PLY files."""
    sampled_poses: int = 40
    """Poses sampled to train on in a scene that has no dataset (a fifth as many again are held out)."""
    sampled_size: tuple[int, int] = (320, 240)
    """Width and height in pixels of pictures from sampled poses."""
    eval_scenes: tuple[str, ...] = ()
    """Names of scenes never to train on, to see how the refiner does on scenes that it does not know."""
    images_per_step: int = 2
    """Training photos of one scene rendered at each step (the paper: 2)."""
    cache_gigabytes: float | None = None
    """Memory for decoded photos, dense and pruned scenes and their renders; by default a quarter of what is free. What
    does not fit is made again when it is due."""
    seed: int = 0
    """Chooses the order of scenes and photos."""


class ScenesDataManager(DataManager):
    """Hands out, at each step, one scene and some of its training photos.

    What a step gets depends on the seed and the step alone, so that a resumed training goes on as if
    it had never stopped. Of W processes, process R takes the places R, W + R, 2 W + R... of one sequence:
    together they see what one process sees in W times the steps.

    Raises:
        SceneError: if ``data`` holds no trained run, or ``eval_scenes`` names one that is not there.
    """

    config: ScenesDataManagerConfig

    def __init__(
        self,
        config: ScenesDataManagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        **kwargs: Any,
    ):
        self.config, self.device, self.test_mode = config, device, test_mode
        self.world_size, self.local_rank = world_size, local_rank
        if config.data is None:
            raise SceneError("--data is missing: expected a trained Splatfacto run, a .ply, or a folder above several")
        if config.images_per_step < 1:
            raise DataError(f"--images-per-step {config.images_per_step}: expected at least 1")
        if config.sampled_poses < 1 or min(config.sampled_size) < 1:
            size = "{} x {}".format(*config.sampled_size)
            raise DataError(f"{config.sampled_poses} sampled poses of {size} pixels: expected at least 1 of 1 x 1")
        gigabytes = config.cache_gigabytes
        self.cache = FrameCache(free_memory_share() if gigabytes is None else int(gigabytes * 1e9))
        held_out_poses = max(1, config.sampled_poses // 5)
        poses = SampledPoses(config.sampled_poses, held_out_poses, *config.sampled_size, seed=config.seed)
        self.supervision, self.scenes = find_scenes(
            Path(config.data), config.supervision, self.cache, poses, device, need_data=test_mode != "inference"
        )
        names = [scene.name for scene in self.scenes]
        unknown = [name for name in config.eval_scenes if name not in names]
        if unknown:
            raise SceneError(
                f"--eval-scenes {unknown[0]}: no such scene in {config.data}; there are {', '.join(names)}"
            )
        self.train_indices = [i for i, name in enumerate(names) if name not in config.eval_scenes]
        self.eval_indices = [i for i, name in enumerate(names) if name in config.eval_scenes] or self.train_indices
        if not self.train_indices:
            raise SceneError(f"--eval-scenes names all {len(names)} scenes of {config.data}; none is left to train on")
        self.shown = names.index(shown_scene(names, config.eval_scenes))
        """The scene that the viewer and the exporter get."""
        training = ", ".join(names[i] for i in self.train_indices)
        held_out = ", ".join(config.eval_scenes) or "no scene (held-out photos of the training scenes serve)"
        targets = "photos" if self.supervision == "photos" else "renders of the dense scenes"
        CONSOLE.log(f"training scenes: {training}; trained on: {targets}; evaluation on: {held_out}")
        super().__init__()

    @property
    def train_dataset(self) -> InputDataset | None:  # type: ignore[override]
        """Training photos of the shown scene, for the viewer."""
        return None if self.test_mode == "inference" else self.training_frames(self.shown).dataset

    @property
    def eval_dataset(self) -> InputDataset | None:  # type: ignore[override]
        """Held-out photos of the shown scene, for the viewer."""
        return None if self.test_mode == "inference" else self.scenes[self.shown].eval_frames.dataset

    @property
    def includes_time(self) -> bool:
        """No scene moves."""
        return False

    def setup_train(self) -> None:
        """Nothing to set up: photos are read when they are due."""

    def setup_eval(self) -> None:
        """Nothing to set up: photos are read when they are due."""

    def training_frames(self, scene: int) -> Any:
        """What a scene is learned from: its photos, or the dense scene's own renders."""
        scene_at = self.scenes[scene]
        return scene_at.train_frames if self.supervision == "photos" else scene_at.rendered_train

    def place(self, step: int) -> int:
        """Where this process is in the sequence of scenes at a step of its own."""
        return step * self.world_size + self.local_rank

    def _choice(self, step: int) -> tuple[int, list[int]]:
        """Scene and photos of a step: each scene once before any twice, photos at random without repetition."""
        step = self.place(step)
        epoch, place = divmod(step, len(self.train_indices))
        order = random.Random(f"{self.config.seed} scenes {epoch}").sample(self.train_indices, len(self.train_indices))
        scene = order[place]
        count = len(self.training_frames(scene))
        chosen = random.Random(f"{self.config.seed} photos {step}")
        return scene, chosen.sample(range(count), min(self.config.images_per_step, count))

    def next_train(self, step: int) -> tuple[int, list[tuple[Cameras, dict[str, Any]]]]:  # type: ignore[override]
        """Index of a training scene, and some of its training photos with their cameras, on the device."""
        scene, photos = self._choice(step)
        targets = self.training_frames(scene)
        frames = [to_device(targets[i], self.device) for i in photos]
        next_scene, next_photos = self._choice(step + 1)
        self.training_frames(next_scene).prefetch(next_photos)
        return scene, frames

    def next_eval(self, step: int) -> tuple[int, list[tuple[Cameras, dict[str, Any]]]]:  # type: ignore[override]
        """Index of an evaluation scene, and one of its held-out photos."""
        scene = self.eval_indices[step % len(self.eval_indices)]
        frames = self.scenes[scene].eval_frames
        if len(frames) == 0:
            raise DataError(
                f"{self.scenes[scene].source}: no frame of its data is held out; change the dataparser's split"
            )
        index = random.Random(f"{self.config.seed} eval {step}").randrange(len(frames))
        return scene, [to_device(frames[index], self.device)]

    def next_eval_image(self, step: int):  # type: ignore[override]
        """As :meth:`next_eval`."""
        return self.next_eval(step)

    def held_out(self, scene: int) -> Iterator[tuple[Cameras, dict[str, Any]]]:
        """Every held-out photo of a scene with its camera, on the device."""
        return (to_device(frame, self.device) for frame in self.scenes[scene].eval_frames)

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a step, for nerfstudio's log."""
        cameras = self.training_frames(self.train_indices[0]).dataset.cameras
        return int(cameras.height[0]) * int(cameras.width[0]) * self.config.images_per_step

    def get_eval_rays_per_batch(self) -> int:
        """Pixels of a held-out photo, for nerfstudio's log."""
        return self.get_train_rays_per_batch() // self.config.images_per_step

    def get_datapath(self) -> Path:
        """What ``--data`` named."""
        assert self.config.data is not None
        return self.config.data

    def get_param_groups(self) -> dict:
        """Nothing here is trained."""
        return {}
