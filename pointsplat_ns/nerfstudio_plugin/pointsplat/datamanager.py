"""The datamanager of refiner training: each step gets one scene and some of its training photos."""

from __future__ import annotations

import dataclasses
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.data.datamanagers.base_datamanager import DataManager, DataManagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.frames import Frame, Frames, MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.pieces import (
    PIECES,
    ScenePiece,
    count_of,
    cut_scenes,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.scene.discovery import Supervision, find_runs_and_plys, shown_scene
from pointsplat_ns.scene.runs import open_run


@dataclass
class ScenesDataManagerConfig(DataManagerConfig):
    """Trained scenes with their posed photos"""

    _target: type = field(default_factory=lambda: ScenesDataManager)
    data: Path | None = None
    """A trained Splatfacto run, a 3DGS .ply, or a folder above several (the newest run of each
    experiment is taken)."""
    scene_data: Path | None = None
    """Where the photos of the runs are now, if they moved: a folder above those of all runs, or
    those of the only one. A run whose photos are not found is left out, and named."""
    supervision: Supervision = "auto"
    """Training targets for renders of the refined scene. photos: the photos of trained runs. dense:
    renders of the dense scene from the dataset's poses, or without a dataset from sampled poses.
    auto: photos for trained runs, dense for PLY files."""
    sampled_poses: int = 40
    """Number of training poses sampled in a scene without a dataset. A fifth of this number is held
    out in addition."""
    sampled_size: tuple[int, int] = (320, 240)
    """Width and height, in pixels, of renders from sampled poses."""
    pieces: int | None = None
    """Cut larger training scenes by planes into pieces of at most so many Gaussians, and train on
    these: many small scenes teach more than few large ones. A piece has its own renders, so this
    needs dense supervision, where it is 12000 by default. 0 trains on whole scenes."""
    cuts: int = 1
    """Number of different cuts of each scene into pieces; each further cut makes pieces of two
    thirds of the size."""
    piece_poses: int = 12
    """Number of poses sampled for each piece."""
    pieces_folder: Path | None = None
    """Keep the poses and renders of pieces there, for later trainings on the same pieces."""
    eval_scenes: tuple[str, ...] = ()
    """Names of scenes never to train on, to evaluate the refiner on unseen scenes."""
    images_per_step: int = 2
    """Training photos of one scene rendered at each step (the paper: 2)."""
    cache_gigabytes: float | None = None
    """Memory for decoded photos, dense and pruned scenes and renders; by default a quarter of the
    free memory. What does not fit is computed again when needed."""
    seed: int = 0
    """Determines the initial weights, the order of scenes and photos, sampled poses and pieces."""


class ScenesDataManager(DataManager):
    """Hands out, at each step, one scene and some of its training photos, by the seed and the step
    alone, so that a resumed training continues as if it had not been stopped. Of W processes,
    process R takes the places R, W + R, 2 W + R... of one sequence: together they see what one
    process sees in W times the steps."""

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
        self.config = config
        self.device = device
        self.test_mode = test_mode
        self.world_size = world_size
        self.local_rank = local_rank
        if config.data is None:
            raise SceneError(
                "--data is missing: expected a trained Splatfacto run, a .ply, or a folder above "
                "several"
            )
        if config.images_per_step < 1:
            raise DataError(f"--images-per-step {config.images_per_step}: expected at least 1")
        if config.sampled_poses < 1 or min(config.sampled_size) < 1:
            size = "{} x {}".format(*config.sampled_size)
            raise DataError(
                f"{config.sampled_poses} sampled poses of {size} pixels: expected at least 1 of 1 "
                "x 1"
            )
        self._pixels = 0
        self._usable: dict[int, bool] = {}
        self.prune_settings: tuple[PruneSettings, ...] = ()
        """How the model prunes scenes: pieces of which too little is left are not trained on."""
        self.cache = MemoryCache.of(config.cache_gigabytes)
        self.left_out: set[str] = set()
        """Identities of the scenes that are there but whose photos are not found."""
        self.supervision, self.scenes = self._found_scenes(Path(config.data))
        names = [scene.name for scene in self.scenes]
        unknown = [name for name in config.eval_scenes if name not in names]
        if unknown:
            raise SceneError(
                f"--eval-scenes {unknown[0]}: no such scene in {config.data}; there are "
                f"{', '.join(names)}"
            )
        self.train_indices = [i for i, name in enumerate(names) if name not in config.eval_scenes]
        self.eval_indices = [
            i for i, name in enumerate(names) if name in config.eval_scenes
        ] or self.train_indices
        if not self.train_indices:
            raise SceneError(
                f"--eval-scenes names all {len(names)} scenes of {config.data}; none is left to "
                "train on"
            )
        self.shown = names.index(shown_scene(names, config.eval_scenes))
        """The scene that the viewer and the exporter get."""
        self.training_names = [names[i] for i in self.train_indices]
        training = ", ".join(self.training_names)
        self.whole_scenes = len(self.scenes)
        """Number of scenes; pieces of them follow these in ``scenes``."""
        pieces = config.pieces
        if pieces is None:
            pieces = PIECES if self.supervision == "dense" else 0
        if pieces and test_mode == "val":
            training = self._cut(pieces)
        held_out = (
            f"evaluating on {', '.join(config.eval_scenes)}, never trained on"
            if config.eval_scenes
            else "no held-out scenes; evaluating on held-out photos of the training scenes"
        )
        targets = "photos" if self.supervision == "photos" else "renders of the dense scenes"
        log(f"training scenes: {training}; trained on {targets}; {held_out}")
        super().__init__()

    def _found_scenes(self, folder: Path) -> tuple[Literal["photos", "dense"], list[DenseScene]]:
        """The kind of training targets, and the scenes that ``--data`` names. Raises SceneError if
        there is none, or photos are needed and those of no run are found; DataError if a training
        fitted colours to each photo."""
        config = self.config
        runs, plys, nothing = find_runs_and_plys(folder, config.supervision)
        if not runs and not plys:
            if nothing is None:
                found = (
                    "a PLY file, which has no photos"
                    if config.supervision == "photos"
                    else "no Gaussians in it"
                )
                found = found if folder.is_file() else "no such file"
                wanted = (
                    "--pipeline.datamanager.supervision dense"
                    if config.supervision == "photos"
                    else "a 3DGS .ply"
                )
                raise SceneError(f"{folder}: {found}; expected {wanted}")
            hint = " (PLY files are trained on with --pipeline.datamanager.supervision dense)"
            hint = hint if config.supervision == "photos" else ", or 3DGS PLY files"
            raise SceneError(f"{nothing}{hint}") from nothing
        chosen: Literal["photos", "dense"] = (
            "dense" if plys or config.supervision == "dense" else "photos"
        )
        scenes: list[DenseScene] = []
        missing: list[str] = []
        for name, run in runs.items():
            has_photos = True
            if self.test_mode != "inference":
                try:
                    run = dataclasses.replace(
                        run, data=open_run(run.config_path, data=config.scene_data).data
                    )
                except SceneError as error:
                    has_photos = False
                    why = f"{run.config_path}: its data {run.data} is not there"
                    missing.append(why if config.scene_data is None else str(error))
                    what = "left out" if chosen == "photos" else "seen from sampled poses"
                    log(f"{name} is {what}: {missing[-1]}")
            scene = TrainedScene(name, run, self.cache, config, self.device, has_photos)
            if has_photos and chosen == "photos" and self.test_mode != "inference":
                scene.need_photos_as_rendered("take --pipeline.datamanager.supervision dense")
            if has_photos or chosen == "dense":
                scenes.append(scene)
            else:
                self.left_out.add(scene.identity)
        scenes += [
            DenseScene(name, path, self.cache, config, self.device) for name, path in plys.items()
        ]
        if not scenes:
            others = f", and that of {len(missing) - 1} more runs" if missing[1:] else ""
            raise SceneError(
                f"{missing[0]}{others}; name the folder where it is now "
                "(--pipeline.datamanager.scene-data DIR), or "
                "take --pipeline.datamanager.supervision dense"
            )
        return chosen, scenes

    def _cut(self, most: int) -> str:
        """Train on pieces of at most ``most`` Gaussians of the training scenes that have more; what
        is trained on, for the log. Raises DataError if pieces cannot be trained on, SceneError if
        nothing can."""
        config = self.config
        if self.supervision != "dense":
            raise DataError(
                f"--pipeline.datamanager.pieces {most}: photos show whole scenes; expected "
                "--pipeline.datamanager.supervision dense"
            )
        if min(most, config.cuts, config.piece_poses) < 1:
            raise DataError(
                f"{config.cuts} cuts into pieces of {most} Gaussians with {config.piece_poses} "
                "poses: expected at least 1 of each"
            )
        large: list[int] = []
        small: list[int] = []
        for index in self.train_indices:
            count = count_of(self.scenes[index])
            if count is not None:
                (large if count > most else small).append(index)
        pieces = cut_scenes([self.scenes[i] for i in large], most, config)
        self.train_indices = small + list(range(len(self.scenes), len(self.scenes) + len(pieces)))
        if not self.train_indices:
            raise SceneError(f"{config.data}: none of its scenes can be trained on")
        self.training_names = [self.scenes[i].name for i in sorted(large + small)]
        whole = [self.scenes[i].name for i in small]
        cut = [f"{len(pieces)} pieces of {', '.join(self.scenes[i].name for i in large)}"]
        self.scenes += pieces
        return ", ".join(whole + (cut if pieces else []))

    @property
    def train_dataset(self) -> InputDataset | None:  # type: ignore[override]
        """Training photos of the shown scene, for the viewer."""
        return None if self.test_mode == "inference" else self.training_frames(self.shown).dataset

    @property
    def eval_dataset(self) -> InputDataset | None:  # type: ignore[override]
        """Held-out photos of the shown scene, for the viewer."""
        return (
            None
            if self.test_mode == "inference"
            else self.scenes[self.shown].frames("test").dataset
        )

    def setup_train(self) -> None:
        """Nothing: photos are read when they are needed."""

    setup_eval = setup_train

    def training_frames(self, scene: int) -> Frames:
        """The training targets of a scene: its photos, or the dense scene's own renders."""
        found = self.scenes[scene]
        return found.frames("train") if self.supervision == "photos" else found.rendered["train"]

    def place(self, step: int) -> int:
        """The place of this process in the common sequence of scenes, at one of its steps."""
        return step * self.world_size + self.local_rank

    def scene_at(self, step: int) -> int:
        """Index of the scene of a step. Each scene comes once before any is repeated. A piece that
        cannot be trained on is logged, and another takes its place."""
        epoch, place = divmod(self.place(step), len(self.train_indices))
        order = random.Random(f"{self.config.seed} scenes {epoch}").sample(
            self.train_indices, len(self.train_indices)
        )
        for index in order[place:] + order[:place]:
            if self._can_train_on(index):
                return index
        raise SceneError(f"{self.config.data}: no piece of its scenes can be trained on")

    def _can_train_on(self, index: int) -> bool:
        """Whether a scene, by its index, is whole, or a piece that can be seen and of which
        something is kept. Pieces that are not are logged once."""
        piece = self.scenes[index]
        if not isinstance(piece, ScenePiece):
            return True
        if index not in self._usable:
            why = piece.why_not(self.prune_settings)
            if why:
                log(f"{piece.name} is left out: {why}")
            self._usable[index] = not why
        return self._usable[index]

    def next_train(self, step: int) -> tuple[int, list[Frame]]:  # type: ignore[override]
        """Index of a training scene, and some of its training photos with their cameras, on this
        process's device: random ones, none of them twice."""
        scene = self.scene_at(step)
        targets = self.training_frames(scene)
        generator = random.Random(f"{self.config.seed} photos {self.place(step)}")
        chosen = generator.sample(
            range(len(targets)), min(self.config.images_per_step, len(targets))
        )
        frames = [targets[i] for i in chosen]
        self._pixels = sum(int(camera.height) * int(camera.width) for camera, _ in frames)
        return scene, frames

    def next_eval_image(self, step: int) -> tuple[int, list[Frame]]:  # type: ignore[override]
        """Index of an evaluation scene, and one of its held-out photos, if there is one."""
        scene = self.eval_indices[step % len(self.eval_indices)]
        frames = self.scenes[scene].frames("test")
        chosen = random.Random(f"{self.config.seed} eval {step}").randrange(max(1, len(frames)))
        return scene, [frames[chosen]] if len(frames) > 0 else []

    def get_train_rays_per_batch(self) -> int:
        """Pixels of the latest step, for nerfstudio's log."""
        return self._pixels

    def get_datapath(self) -> Path:
        """The path given by ``--data``."""
        assert self.config.data is not None
        return self.config.data

    def get_param_groups(self) -> dict:
        """Nothing here is trained."""
        return {}
