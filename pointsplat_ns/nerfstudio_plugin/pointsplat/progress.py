"""What a training gains, measured while it runs: fixed views of each scene, pruned and refined."""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pointsplat_ns.metrics.images import finite_psnr
from pointsplat_ns.nerfstudio_plugin.frames import Frame, Frames
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import SceneGain
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system import processes
from pointsplat_ns.system.files import replacing

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline

VIEWS = 2
"""Views of each scene that are measured."""

SCENES = 8
"""Most scenes of each kind, trained on or not, that are measured."""

MOST_TIME = 0.05
"""Largest share of the time of a training that measuring takes, but for the first and the last
time."""

CURVES = "training.csv"
"""The file of all measurements in the folder of a run."""

CURVES_PICTURE = "training.png"
SHEET = "views.png"
"""Pictures in the folder of a run: its curves, and views of scenes."""

MOST_ROWS = 6
"""Scenes on a sheet."""


@dataclass
class Smoothed:
    """A mean of the latest values, of which older ones count less."""

    decay: float = 0.9
    total: float = 0.0
    weight: float = 0.0

    def add(self, value: float) -> None:
        """Take a value in."""
        self.total = self.decay * self.total + (1 - self.decay) * value
        self.weight = self.decay * self.weight + (1 - self.decay)

    @property
    def value(self) -> float:
        """The mean; NaN without a value."""
        return self.total / self.weight if self.weight else float("nan")


@dataclass(frozen=True)
class Measurement:
    """Gains of all scenes after a number of steps."""

    step: int
    """Steps done."""
    seconds: float
    """Time of the training so far."""
    loss: float
    """Smoothed loss, mean over the scenes; NaN before the first step."""
    gains: tuple[SceneGain, ...]


@dataclass
class Curves:
    """The smoothed loss of each scene, and all measurements of a training."""

    losses: dict[str, Smoothed] = field(default_factory=dict)
    """By the name of the scene."""
    loss_history: list[tuple[int, float]] = field(default_factory=list)
    """Steps done and the smoothed loss."""
    measurements: list[Measurement] = field(default_factory=list)

    def add_loss(self, step: int, scene: str, loss: float) -> None:
        """Take in the loss of a step."""
        self.losses.setdefault(scene, Smoothed()).add(loss)
        self.loss_history.append((step + 1, self.loss))

    @property
    def loss(self) -> float:
        """The smoothed loss, mean over the scenes; NaN before the first step."""
        return fmean(s.value for s in self.losses.values()) if self.losses else float("nan")

    def write(self, path: Path) -> None:
        """Write all measurements as a table, a row for each scene of each."""
        with (
            replacing(path, named=False) as part,
            part.open("w", newline="", encoding="utf-8") as stream,
        ):
            table = csv.writer(stream, lineterminator="\n")
            table.writerow(
                ("step", "seconds", "loss", "scene", "trained_on", "views")
                + ("pruned_db", "refined_db", "gain_db")
            )
            for at in self.measurements:
                for scene in at.gains:
                    numbers = (scene.pruned, scene.refined, scene.gain)
                    table.writerow(
                        (at.step, f"{at.seconds:.1f}", f"{at.loss:.6f}", scene.name)
                        + (scene.trained_on, scene.views, *(f"{value:.3f}" for value in numbers))
                    )


def spread(indices: list[int]) -> list[int]:
    """At most :data:`SCENES` of the indices, spread over all."""
    count = min(len(indices), SCENES)
    return [indices[int((i + 0.5) * len(indices) / count)] for i in range(count)]


class Progress:
    """Measures fixed views of each scene: :data:`VIEWS` held-out ones, spread over all. Where there
    are none, training views. Of many scenes, :data:`SCENES` of each kind, spread over all, stand
    for the others. Pieces are not measured, but the scenes that they are of. Processes share the
    scenes."""

    def __init__(self, pipeline: PointSplatPipeline):
        self.pipeline = pipeline
        manager = pipeline.datamanager
        held_out = set(manager.config.eval_scenes)
        whole = range(manager.whole_scenes)
        self.own = spread([i for i in whole if manager.scenes[i].name not in held_out])
        """Indices of the measured scenes that are trained on."""
        self.others = spread([i for i in whole if manager.scenes[i].name in held_out])
        """Indices of the measured scenes that are not."""
        self.curves = Curves()
        self.spent = 0.0
        """Time that measuring took so far, seconds, without the first time, when scenes are read
        and pruned and views sampled."""
        self.latest = 0.0
        """Time that refining and drawing all scenes took the last time, seconds."""
        self._pruned: dict[int, float] = {}

    def due(self, seconds: float) -> bool:
        """Whether measuring again keeps within its share of a training that has taken so long, by
        the clock of the first process."""
        return processes.gathered([self.spent + self.latest <= MOST_TIME * seconds])[0]

    def frames(self, index: int) -> tuple[Frames, list[int]]:
        """Frames of a scene, and which of them are measured."""
        manager = self.pipeline.datamanager
        frames = manager.scenes[index].frames("test")
        if len(frames) == 0:
            frames = manager.training_frames(index)
        count = min(VIEWS, len(frames))
        return frames, [int((i + 0.5) * len(frames) / count) for i in range(count)]

    @torch.no_grad()
    def measure(self, step: int) -> Measurement:
        """Measure all scenes after a number of steps; the model is left as it was."""
        pipeline = self.pipeline
        training = pipeline.training
        pipeline.eval()
        self.latest = 0.0
        try:
            shared = [*self.own, *self.others][processes.rank() :: pipeline.world_size]
            found = [(index, self._gain(index)) for index in shared]
        finally:
            pipeline.train(training)
        gains = [gain for _, gain in sorted(processes.gathered(found), key=lambda pair: pair[0])]
        result = Measurement(
            step=step, seconds=pipeline.seconds, loss=self.curves.loss, gains=tuple(gains)
        )
        self.latest = processes.gathered([self.latest])[0]
        if self.curves.measurements:
            self.spent += self.latest
        self.curves.measurements.append(result)
        return result

    def _gain(self, index: int) -> SceneGain:
        pipeline = self.pipeline
        model = pipeline.model
        scene = pipeline.datamanager.scenes[index]
        found = model.pruned_scene(index)
        frames, chosen = self.frames(index)
        shown = [frames[i] for i in chosen]
        if index not in self._pruned:
            self._pruned[index] = self._psnr(index, found.pruned, shown)
        start = time.monotonic()
        refined = self._psnr(index, model.refiner(*found), shown)
        self.latest += time.monotonic() - start
        return SceneGain(
            name=scene.name,
            trained_on=scene.identity in pipeline.trained_on,
            views=len(chosen),
            pruned=self._pruned[index],
            refined=refined,
        )

    def _psnr(self, index: int, gaussians: Gaussians, frames: Sequence[Frame]) -> float:
        """Mean PSNR of a scene in photos, dB; the model is in evaluation mode."""
        model = self.pipeline.model
        scene = self.pipeline.datamanager.scenes[index]
        values = []
        for camera, data in frames:
            outputs = model.draw(gaussians, scene, camera)
            values.append(finite_psnr(outputs["rgb"], model.photo_of(data, outputs["background"])))
        return fmean(values)

    @torch.no_grad()
    def pictures(self, index: int) -> dict[str, tuple[Tensor, float | None]]:
        """The first measured view of a scene: the photo, and each variant with its PSNR, dB;
        without photos the dense render takes their place. Pictures are (H, W, 3) on the CPU."""
        pipeline = self.pipeline
        model = pipeline.model
        scene = pipeline.datamanager.scenes[index]
        training = pipeline.training
        pipeline.eval()
        try:
            scene_found = model.pruned_scene(index)
            frames, chosen = self.frames(index)
            camera, data = frames[chosen[0]]
            variants = {"pruned": scene_found.pruned, "refined": model.refiner(*scene_found)}
            if scene.has_photos:
                variants = {"dense": scene.dense(keep=False).to(model.device), **variants}
            found: dict[str, tuple[Tensor, float | None]] = {}
            for name, gaussians in variants.items():
                outputs = model.draw(gaussians, scene, camera)
                photo = model.photo_of(data, outputs["background"])
                found.setdefault("photo" if scene.has_photos else "dense", (photo.cpu(), None))
                found[name] = outputs["rgb"].cpu(), finite_psnr(outputs["rgb"], photo)
        finally:
            pipeline.train(training)
        return found
