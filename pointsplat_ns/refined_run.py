"""A trained ``pointsplat`` run, opened without nerfstudio and without running its ``config.yml``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.plys import find_runs_and_plys
from pointsplat_ns.io.runs import Run, open_run, shown_scene
from pointsplat_ns.io.safe_globals import allow_splatfacto_checkpoints
from pointsplat_ns.pruning import WEIGHTED, compact
from pointsplat_ns.refiner import Refiner, preset

METHOD = "pointsplat"
_PREFIX = "_model.refiner."


@dataclass(frozen=True, eq=False)
class RefinedRun:
    """A trained refiner, how it expects scenes to be pruned, and the scenes of its run by name."""

    run: Run
    refiner: Refiner
    prune_options: dict[str, Any]
    scenes: dict[str, Path]
    """The checkpoint or PLY that holds each dense scene."""
    default_scene: str

    @torch.no_grad()
    def compact(self, dense: Gaussians, keep: float | int | None = None) -> Gaussians:
        """Prune a scene as the refiner was trained to see it, and refine it.

        Args:
            dense: on the CPU.
            keep: ratio (float) or count (int); by default the one of the training.

        Raises:
            BudgetError: if ``keep`` does not fit the scene.
            SceneError: if the scene has a higher SH degree than the refiner.
        """
        options = self.prune_options if keep is None else {**self.prune_options, "keep": keep}
        return self.refiner(compact(dense, **options))


def prune_options(keep: float, score: str, opacity_weight: float) -> dict[str, Any]:
    """Arguments of :func:`pointsplat_ns.pruning.compact` for a model's settings; ``keep`` above 1 is a count.

    Raises:
        BudgetError: if ``keep`` is neither a ratio nor a whole number.
    """
    if not 0 < keep < math.inf or (keep > 1 and keep != int(keep)):  # NaN fails too
        raise BudgetError(
            f"keep is {keep:g}; expected a ratio above 0 and up to 1 (such as 0.3) or a whole number of Gaussians "
            "(such as 50000)"
        )
    extra = {"opacity_weight": opacity_weight} if score in WEIGHTED else {}
    return {"keep": int(keep) if keep > 1 else float(keep), "by": score, **extra}


def network_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Changes to a size's preset that a model's settings ask for. A run from before a setting has its default.

    Raises:
        KeyError: if the encoder is not named.
    """
    defaults = {"use_appearance": True, "use_position": True, "norm": "scene"}
    return {"encoder": settings["encoder"], **{name: settings.get(name, value) for name, value in defaults.items()}}


def open_refined_run(path: Path | str, need_scenes: bool = True) -> RefinedRun:
    """Open a trained ``pointsplat`` run.

    Args:
        path: its folder, ``config.yml`` or checkpoint.
        need_scenes: find the Splatfacto runs and PLY files that it was trained on.

    Raises:
        SceneError: if it is another kind of run, is damaged, or its scenes are needed and gone.
    """
    run = open_run(path, need_data=need_scenes)
    if run.method_name != METHOD:
        raise SceneError(f"{path}: a run of the method {run.method_name or 'unknown'}; expected a {METHOD} run")
    settings = run.model_fields
    try:
        refiner = Refiner(preset(settings["size"], **network_options(settings)))
        options = prune_options(float(settings["keep"]), settings["score"], float(settings["opacity_weight"]))
        allow_splatfacto_checkpoints()  # for the numbers in the schedulers' state
        state = torch.load(run.checkpoint, map_location="cpu", weights_only=True, mmap=True)["pipeline"]
        weights = {name[len(_PREFIX) :]: value for name, value in state.items() if name.startswith(_PREFIX)}
        refiner.load_state_dict(weights)
    except KeyError as error:
        raise SceneError(f"{run.config_path}: lacks {error}; expected a {METHOD} run of this version") from error
    except PointSplatError as error:
        raise SceneError(f"{run.config_path}: {error}") from error
    except Exception as error:  # a damaged archive can raise nearly anything
        text = " ".join(str(error).split())[:160]
        raise SceneError(f"{run.checkpoint}: not a usable {METHOD} checkpoint ({text})") from error
    scenes: dict[str, Path] = {}
    default = ""
    if need_scenes:
        scenes = _scenes_of(run)
        default = shown_scene(list(scenes), run.datamanager_fields.get("eval_scenes") or ())
    return RefinedRun(run, refiner.eval(), options, scenes, default)


def _scenes_of(run: Run) -> dict[str, Path]:
    """Where the scenes are that a run was trained on, by the names that the training gave them."""
    runs, plys, nothing = find_runs_and_plys(run.data, run.datamanager_fields.get("supervision", "auto"))
    scenes = {name: found.checkpoint for name, found in runs.items()} | plys
    if not scenes:
        raise SceneError(f"{run.config_path}: {nothing or f'{run.data}: no Gaussians in it'}; put its scenes back")
    return scenes
