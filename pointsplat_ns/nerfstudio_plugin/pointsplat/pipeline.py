"""The PointSplat pipeline: training over many scenes, and an evaluation of dense, pruned and
refined scenes."""

from __future__ import annotations

import dataclasses
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from nerfstudio.engine.callbacks import (
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from pointsplat_ns.errors import SceneError
from pointsplat_ns.metrics.lpips import ReportedLpips
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.pointsplat import evaluation
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import (
    ScenesDataManager,
    ScenesDataManagerConfig,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import (
    compared_variants,
    evaluate_scene,
    only_finite,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel, PointSplatModelConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import selection_text
from pointsplat_ns.pipeline.trained_refiner import network_options
from pointsplat_ns.refinement import save_refiner
from pointsplat_ns.scene.runs import RUN_FILES
from pointsplat_ns.system import processes
from pointsplat_ns.system.terminal import say

MODEL_METADATA = (
    "size",
    "encoder",
    "use_appearance",
    "use_position",
    "enc_depths",
    "stem",
    "raw_inputs",
    "by",
    "opacity_weight",
    "units",
    "norm",
    "means_reach",
    "train_encoder",
    "pixel_loss",
    "lpips_weight",
    "lpips_net",
)
"""Settings of the model in the metadata of a saved network."""


@runtime_checkable
class Reporting(Protocol):
    """A trainer that reports what the training gained."""

    def report(self) -> None:
        """Print and draw it."""


@dataclass
class PointSplatPipelineConfig(VanillaPipelineConfig):
    """Scenes, and the model that prunes and refines them"""

    _target: type = field(default_factory=lambda: PointSplatPipeline)
    datamanager: ScenesDataManagerConfig = field(default_factory=ScenesDataManagerConfig)
    model: PointSplatModelConfig = field(default_factory=PointSplatModelConfig)


class PointSplatPipeline(VanillaPipeline):
    """Each step prunes and refines one scene and renders it from some of its training cameras."""

    datamanager: ScenesDataManager
    config: PointSplatPipelineConfig

    def __init__(
        self,
        config: PointSplatPipelineConfig,
        device: str | torch.device,
        test_mode: Literal["test", "val", "inference"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: Any = None,
    ):
        super(VanillaPipeline, self).__init__()
        if world_size != processes.world_size():
            raise SceneError(
                f"{world_size} processes are asked for and {processes.world_size()} are connected; "
                "start them with torchrun, or, on GPUs, by ns-train --machine.num-devices"
            )
        if world_size > 1 and config.model.norm == "batch":
            raise SceneError(
                "--pipeline.model.norm batch: its statistics are of the scenes of one process; "
                "expected scene where several processes train together"
            )
        if world_size > 1 and torch.device(device).type == "cuda":
            torch.cuda.set_device(local_rank)  # nccl gathers objects through the current device
        self.config = config
        self.test_mode = test_mode
        self.world_size = world_size
        self.datamanager = config.datamanager.setup(
            device=device, test_mode=test_mode, world_size=world_size, local_rank=processes.rank()
        )
        torch.manual_seed(config.datamanager.seed)
        self._model = config.model.setup(
            scene_box=None, num_train_data=0, device=device, datamanager=self.datamanager
        )
        self.model.to(device)
        processes.share_state(self.model.refiner)
        scenes = self.datamanager.scenes
        indices = self.datamanager.train_indices
        self.trained_on = {scenes[i].identity for i in indices} if test_mode == "val" else set()
        """Identities of the scenes that the network has been trained on, also before it was
        resumed."""
        self.seconds = 0.0
        """Duration of the training so far, also before it was resumed."""
        if processes.rank() == 0:
            say(selection_text(config.model.prune_settings()), flush=True)

    def get_extra_state(self) -> dict[str, Any]:
        """What checkpoints hold beside weights and optimisers, for torch's ``state_dict``."""
        return {"trained_on": sorted(self.trained_on), "seconds": self.seconds}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Load the state of a checkpoint; logs which of its scenes are missing now. Scenes whose
        photos are not found are there: the log has named them."""
        self.seconds = state.get("seconds", 0.0)
        self.trained_on |= set(state["trained_on"])
        gone = set(state["trained_on"]) - {scene.identity for scene in self.datamanager.scenes}
        gone -= self.datamanager.left_out
        if gone:
            log(
                f"trained on {', '.join(sorted(gone))}, which {self.datamanager.get_datapath()} "
                "no longer has"
            )

    @property
    def model(self) -> PointSplatModel:
        """The model, which is not wrapped for distributed training: the trainer averages
        gradients."""
        return self._model  # type: ignore[return-value]

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict, dict]:
        """Outputs of the last photo's camera, losses and metrics of one scene at some of its
        training photos. Random numbers depend only on the seed and on the scene's place in the
        sequence, so that a training can be resumed."""
        place = self.datamanager.place(step)
        torch.manual_seed(
            random.Random(f"{self.config.datamanager.seed} network {place}").getrandbits(63)
        )
        index, frames = self.datamanager.next_train(step)
        outputs, losses, metrics = self.model.losses(index, frames)
        return outputs, losses, metrics | {"scene": index}

    @torch.no_grad()
    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """The summary of all held-out photos of all scenes, and ``lpips_note`` if LPIPS is missing.
        Images of photo and variants side by side go to ``output_path``. Given a ``step``, by the
        trainer, whose log takes only finite numbers, only those are returned."""
        training = self.training
        self.eval()
        manager = self.datamanager
        model = self.model
        lpips = ReportedLpips()
        reports: list[evaluation.SceneReport] = []
        for index in range(processes.rank(), manager.whole_scenes, self.world_size):
            scene = manager.scenes[index]
            dense = scene.dense(keep=False)
            found = model.pruned_scene(index, dense)
            variants = {
                "dense": dense.to(model.device),
                "pruned": found.pruned,
                **compared_variants(scene, dense, len(found.pruned)),
                "refined": model.refiner(*found),
            }
            report = evaluate_scene(
                model, scene, variants, scene.frames("test"), lpips, output_path, progress=True
            )
            report.seen_in_training = scene.identity in self.trained_on
            reports.append(report)
        self.train(training)
        order = {scene.name: index for index, scene in enumerate(manager.scenes)}
        reports = sorted(processes.gathered(reports), key=lambda report: order[report.name])
        summary = evaluation.summarize(reports, get_std)
        config = self.config.model
        pruning = dataclasses.asdict(config.prune_settings())
        by_units = {name: getattr(model.refiner.config, name) for name in ("norm", "means_reach")}
        options = network_options(vars(config)) | by_units
        summary["settings"] = {"size": config.size, **options, **pruning}
        summary["supervision"] = manager.supervision
        if lpips.reason is not None:
            summary["lpips_note"] = lpips.reason
        if step is not None:
            return only_finite(summary)
        if processes.rank() == 0:
            evaluation.print_summary(summary)
        return summary

    def get_training_callbacks(
        self, attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """At the end of training, saves the network alone, for use without the training scenes, and
        lets the trainer report."""

        def save(step: int) -> None:
            trainer = attributes.trainer
            model = self.config.model
            of_trainer = ("method_name", "rate_factor", "schedule", "drop_at", "global_norm")
            if trainer is not None and processes.rank() == 0:
                names = self.datamanager.training_names
                save_refiner(
                    self.model.refiner,
                    trainer.base_dir / RUN_FILES.refiner,
                    {
                        "steps": step + 1,
                        "scenes": ", ".join(names),
                        "supervision": self.datamanager.supervision,
                        "keep": model.prune_settings().keep,
                        "more_keeps": [model.prune_settings(k).keep for k in model.more_keeps],
                        **{name: getattr(model, name) for name in MODEL_METADATA},
                        **{name: getattr(trainer.config, name) for name in of_trainer},
                    },
                )
            if isinstance(trainer, Reporting):
                trainer.report()

        return [TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], save)]
