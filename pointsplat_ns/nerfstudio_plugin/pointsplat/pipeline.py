"""The PointSplat pipeline: training across scenes, and an evaluation that compares dense, pruned and refined."""

from __future__ import annotations

import dataclasses
import math
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch.cuda.amp.grad_scaler import GradScaler

from pointsplat_ns.compression.trained_refiner import network_options
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.pointsplat import distributed
from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import SceneReport, evaluate_scene, summarize
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import (
    PIXEL_LOSSES,
    PointSplatModel,
    PointSplatModelConfig,
    settings_of,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import ScenesDataManager, ScenesDataManagerConfig
from pointsplat_ns.refiner import save_refiner

REFINER_NAME = "refiner.safetensors"
"""The trained network, in the run's folder: what ``pointsplat compact --using`` takes."""

_REDUCED = (*PIXEL_LOSSES, "lpips", "psnr")
"""What is averaged over processes at each step."""


@dataclass
class PointSplatPipelineConfig(VanillaPipelineConfig):
    """Scenes, and the model that prunes and refines them"""

    _target: type = field(default_factory=lambda: PointSplatPipeline)
    datamanager: ScenesDataManagerConfig = field(default_factory=ScenesDataManagerConfig)
    model: PointSplatModelConfig = field(default_factory=PointSplatModelConfig)


class PointSplatPipeline(VanillaPipeline):
    """One step: one scene, pruned and refined, rendered from some of its training cameras.

    Raises:
        SceneError: if ``--data`` holds no scene, or ``world_size`` processes are not connected.
    """

    datamanager: ScenesDataManager
    config: PointSplatPipelineConfig

    def __init__(
        self,
        config: PointSplatPipelineConfig,
        device: str | torch.device,
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: GradScaler | None = None,
    ):
        super(VanillaPipeline, self).__init__()
        if world_size != distributed.world_size():
            raise SceneError(
                f"{world_size} processes are asked for and {distributed.world_size()} are connected; start them with "
                "ns-train --machine.num-devices, on GPUs, or join them with torch.distributed"
            )
        if world_size > 1 and torch.device(device).type == "cuda":
            torch.cuda.set_device(local_rank)  # what is gathered travels by the current device
        self.config, self.test_mode, self.world_size = config, test_mode, world_size
        self.datamanager = config.datamanager.setup(
            device=device, test_mode=test_mode, world_size=world_size, local_rank=distributed.rank()
        )
        torch.manual_seed(config.datamanager.seed)
        self._model = config.model.setup(scene_box=None, num_train_data=0, device=device, grad_scaler=grad_scaler)
        self.model.to(device)
        self.model.attach(self.datamanager.scenes, self.datamanager.shown, self.datamanager.cache)
        distributed.share_state(self.model.refiner)
        if world_size > 1:
            distributed.synchronise_batch_norm(self.model.refiner)
        self._saved_groups: list[str] = []
        self.faults: list[str] = []
        """Losses of the latest training step in this process that were not finite, in words."""
        self.counted: dict[str, int] = {}
        """Steps whose gradients are gathered, by part of the network."""
        self.skipped: Counter[str] = Counter()
        """Steps that were left out because a loss or a gradient was not finite, by scene, over all processes."""
        scenes, indices = self.datamanager.scenes, self.datamanager.train_indices
        self.trained_on: set[str] = {scenes[i].identity for i in indices} if test_mode == "val" else set()
        """Identities of the scenes that the network has been trained on, resumed trainings included."""

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint says beside the weights: which scenes they were trained on, how many steps were skipped,
        and gradients in waiting."""
        state: dict[str, Any] = {"trained_on": sorted(self.trained_on), "skipped": dict(self.skipped)}
        if self._saved_groups:
            groups = self.get_param_groups()
            state["gradients"] = {name: [p.grad for p in groups[name]] for name in self._saved_groups}
            state["counted"] = {name: self.counted[name] for name in self._saved_groups if name in self.counted}
        return state

    @contextmanager
    def saving_gradients(self, groups: list[str]) -> Iterator[None]:
        """Within, a checkpoint holds the gradients of these parts of the network."""
        self._saved_groups = groups
        try:
            yield
        finally:
            self._saved_groups = []

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Remember what a checkpoint was trained on, and say so if scenes have gone since; take up gradients that
        were gathering when it was saved, and the count of skipped steps, but for those of scenes that are gone."""
        for name, gradients in state.get("gradients", {}).items():
            for p, gradient in zip(self.get_param_groups()[name], gradients, strict=True):
                p.grad = None if gradient is None else gradient.to(p)
        self.counted.update(state.get("counted", {}))
        names = {scene.name for scene in self.datamanager.scenes}
        self.skipped = Counter({name: count for name, count in state.get("skipped", {}).items() if name in names})
        known = set(state["trained_on"])
        gone = known - {scene.identity for scene in self.datamanager.scenes}
        if gone:
            CONSOLE.log(f"trained on {', '.join(sorted(gone))}, which {self.datamanager.get_datapath()} no longer has")
        self.trained_on |= known

    @property
    def model(self) -> PointSplatModel:
        """The model; never wrapped."""
        return self._model  # type: ignore[return-value]

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict, dict]:
        """Losses of one scene at some of its training photos.

        Random numbers (the order of serialization curves, dropped paths) depend on the seed and the place of the
        scene in the sequence alone, as the choice of scene and photos does: a resumed training goes on as if it had
        never stopped. Several processes take turns in that sequence; the values of their losses and metrics are the
        mean over processes, the gradients each process's own. Losses that are not finite are in ``faults``.
        """
        place = self.datamanager.place(step)
        torch.manual_seed(random.Random(f"{self.config.datamanager.seed} network {place}").getrandbits(63))
        index, frames = self.datamanager.next_train(step)
        outputs, losses, metrics = self.model.losses(index, frames)
        self.faults = [f"the {name} loss is {v.item()}" for name, v in losses.items() if not v.isfinite()]
        means = distributed.means_over_ranks({**losses, "psnr": metrics["psnr"]}, _REDUCED)
        if self.world_size > 1:
            losses = {name: distributed.with_value(value, means[name]) for name, value in losses.items()}
        metrics |= {"psnr": means["psnr"], "scene": index}
        return outputs, losses, metrics

    @torch.no_grad()
    def get_eval_loss_dict(self, step: int) -> tuple[Any, dict, dict]:
        """Losses at one held-out photo."""
        training = self.training
        self.eval()
        index, frames = self.datamanager.next_eval(step)
        result = self.model.losses(index, frames)
        self.train(training)
        return result

    @torch.no_grad()
    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict, dict]:
        """One held-out photo: metrics, and a picture of photo, pruned and refined side by side."""
        training = self.training
        self.eval()
        index, frames = self.datamanager.next_eval_image(step)
        made = self.model.pruned_scene(index)
        report = evaluate_scene(
            self.model, made.scene, {"pruned": made.pruned, "refined": self.model.refine(index)}, frames, False
        )
        pixels = int(frames[0][0].height) * int(frames[0][0].width)
        metrics: dict[str, Any] = {"num_rays": pixels}
        for variant, values in report.variants.items():
            metrics |= _finite({f"{name}_{variant}": value for name, value in values.items()})
        self.train(training)
        return metrics, {"photo_pruned_refined": report.last_picture}

    @torch.no_grad()
    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Dense, pruned and refined scenes over all held-out photos of all scenes.

        Args:
            step: given by the trainer, whose log takes numbers alone: only those are returned then.
            output_path: folder for pictures of photo, dense, pruned and refined side by side.
            get_std: add the standard deviation of the refined scenes' metrics over photos.

        Returns:
            ``psnr``, ``ssim`` and ``lpips`` of the refined scenes (of those never trained on, if there are any),
            ``average``, ``average_unseen`` and ``average_seen`` (over scenes, by variant), and ``scenes``. What
            cannot be computed is None, and ``lpips_note`` says why LPIPS is missing. ``reference`` says what renders
            were compared with, here and in each scene: ``photos``, or ``dense renders`` where a scene has no photos
            (the dense scene is then the reference, and has no PSNR). Where there are both, the figures above are those
            against photos, and ``against_dense_renders`` holds the others.
        """
        training = self.training
        self.eval()
        manager, model = self.datamanager, self.model
        reports: list[SceneReport] = []
        mine = range(distributed.rank(), len(manager.scenes), self.world_size)
        for index in mine:
            scene = manager.scenes[index]
            dense = scene.dense(keep=False)
            made = model.pruned_scene(index, dense)
            refined, seconds = model.timed_refine(index)
            variants = {"dense": dense.to(model.device), "pruned": made.pruned, "refined": refined}
            report = evaluate_scene(model, scene, variants, manager.held_out(index), True, output_path)
            report.seen_in_training = scene.identity in self.trained_on
            report.seconds = {"prune": made.seconds, "refine": seconds}
            report.last_picture = None
            reports.append(report)
        self.train(training)
        order = {scene.name: index for index, scene in enumerate(manager.scenes)}
        reports = sorted(distributed.gathered(reports), key=lambda report: order[report.name])
        summary = summarize_by_reference(reports, [scene.has_photos for scene in manager.scenes], get_std)
        summary["settings"] = {
            "size": self.config.model.size,
            **network_options(vars(self.config.model)),
            **dataclasses.asdict(settings_of(self.config.model)),
        }
        summary["supervision"] = manager.supervision
        if model.lpips_reason is not None:
            summary["lpips_note"] = model.lpips_reason
        if step is None:
            return summary
        return _finite(summary)

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """Saves the network by itself at the end of training, for use without the scenes that it was trained on."""

        def save(step: int) -> None:
            trainer = attributes.trainer
            if trainer is not None and distributed.rank() == 0:
                names = [self.datamanager.scenes[i].name for i in self.datamanager.train_indices]
                save_refiner(
                    self.model.refiner,
                    trainer.base_dir / REFINER_NAME,
                    {
                        "step": str(step),
                        "scenes": ", ".join(names),
                        "keep": str(self.config.model.keep),
                        "by": self.config.model.by,
                        "opacity_weight": self.config.model.opacity_weight,
                    },
                )

        return [TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], save)]


def summarize_by_reference(reports: list[SceneReport], has_photos: list[bool], with_std: bool) -> dict[str, Any]:
    """:func:`~pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation.summarize`, where no mean mixes what was compared with photos and what was
    compared with the dense scene's own renders."""
    names = {True: "photos", False: "dense renders"}
    parts = {
        photos: summarize([r for r, kind in zip(reports, has_photos, strict=True) if kind == photos], with_std)
        for photos in sorted(set(has_photos), reverse=True)
    }
    for photos, part in parts.items():
        part["reference"] = names[photos]
        for row in part["scenes"].values():
            row["reference"] = names[photos]
    summary = next(iter(parts.values()))
    if len(parts) == 2:
        other = parts[False]
        rows = {**summary["scenes"], **other.pop("scenes")}
        summary["scenes"] = {r.name: rows[r.name] for r in reports}
        summary["against_dense_renders"] = other
    return summary


def _finite(values: dict[str, Any]) -> dict[str, float]:
    """What nerfstudio's writers can log."""
    return {name: v for name, v in values.items() if isinstance(v, float) and math.isfinite(v)}
