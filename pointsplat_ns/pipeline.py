"""The PointSplat pipeline: training across scenes, and an evaluation that compares dense, pruned and refined."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch.cuda.amp.grad_scaler import GradScaler

from pointsplat_ns.data.scenes import ScenesDataManager, ScenesDataManagerConfig
from pointsplat_ns.evaluation import SceneReport, evaluate_scene, summarize
from pointsplat_ns.model import PointSplatModel, PointSplatModelConfig, options_of
from pointsplat_ns.refiner import save_refiner

REFINER_NAME = "refiner.safetensors"
"""The trained network, in the run's folder: what ``pointsplat refine --using RUN`` needs."""


@dataclass
class PointSplatPipelineConfig(VanillaPipelineConfig):
    """Scenes, and the model that prunes and refines them"""

    _target: type = field(default_factory=lambda: PointSplatPipeline)
    datamanager: ScenesDataManagerConfig = field(default_factory=ScenesDataManagerConfig)
    model: PointSplatModelConfig = field(default_factory=PointSplatModelConfig)


class PointSplatPipeline(VanillaPipeline):
    """One step: one scene, pruned and refined, rendered from some of its training cameras.

    Raises:
        SceneError: if ``--data`` holds no trained scene.
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
        self.config, self.test_mode, self.world_size = config, test_mode, world_size
        self.datamanager = config.datamanager.setup(
            device=device, test_mode=test_mode, world_size=world_size, local_rank=local_rank
        )
        torch.manual_seed(config.datamanager.seed)
        self._model = config.model.setup(scene_box=None, num_train_data=0, device=device, grad_scaler=grad_scaler)
        self.model.to(device)
        self.model.attach(self.datamanager.scenes, self.datamanager.shown)
        scenes, indices = self.datamanager.scenes, self.datamanager.train_indices
        self.trained_on: set[str] = {scenes[i].identity for i in indices} if test_mode == "val" else set()
        """Identities of the scenes that the network has been trained on, resumed trainings included."""

    def get_extra_state(self) -> dict[str, list[str]]:
        """What a checkpoint says beside the weights: which scenes they were trained on."""
        return {"trained_on": sorted(self.trained_on)}

    def set_extra_state(self, state: dict[str, list[str]]) -> None:
        """Remember what a checkpoint was trained on, and say so if scenes have come or gone since."""
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

        Random numbers (the order of serialization curves, dropped paths) depend on the seed and the step
        alone, as the choice of scene and photos does: a resumed training goes on as if it had never stopped.
        """
        torch.manual_seed(random.Random(f"{self.config.datamanager.seed} network {step}").getrandbits(63))
        index, frames = self.datamanager.next_train(step)
        outputs, losses, metrics = self.model.losses(index, frames)
        metrics["scene"] = index
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
            cannot be computed is None, and ``lpips_note`` says why LPIPS is missing.
        """
        training = self.training
        self.eval()
        manager, model = self.datamanager, self.model
        reports: list[SceneReport] = []
        for index, scene in enumerate(manager.scenes):
            dense = scene.read_dense()
            made = model.pruned_scene(index, dense)
            refined, seconds = model.timed_refine(index)
            variants = {"dense": dense.to(model.device), "pruned": made.pruned, "refined": refined}
            report = evaluate_scene(model, scene, variants, manager.held_out(index), True, output_path)
            report.seen_in_training = scene.identity in self.trained_on
            report.seconds = {"prune": made.seconds, "refine": seconds}
            reports.append(report)
        self.train(training)
        summary = summarize(reports, get_std)
        summary["settings"] = {"size": self.config.model.size, **options_of(self.config.model)}
        if model.lpips_reason is not None:
            summary["lpips_note"] = model.lpips_reason
        if step is None:
            return summary
        return _finite(summary)

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        """Saves the network by itself at the end of training, for use without the scenes that it was trained on."""

        def save(step: int) -> None:
            trainer = attributes.trainer
            if trainer is not None:
                names = [self.datamanager.scenes[i].name for i in self.datamanager.train_indices]
                save_refiner(
                    self.model.refiner,
                    trainer.base_dir / REFINER_NAME,
                    {"step": str(step), "scenes": ", ".join(names), "keep": str(self.config.model.keep)},
                )

        return [TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], save)]


def _finite(values: dict[str, Any]) -> dict[str, float]:
    """What nerfstudio's writers can log."""
    return {name: v for name, v in values.items() if isinstance(v, float) and math.isfinite(v)}
