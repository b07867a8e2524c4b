"""Loads trained refiners with their pruning settings: the shipped one, a file of weights, or a run.

Reading needs no nerfstudio, and never executes a run's ``config.yml``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.pipeline.options import default_device
from pointsplat_ns.pruning import PruneSettings, method_named
from pointsplat_ns.refinement import (
    Refiner,
    WeightsError,
    read_metadata,
    read_refiner,
    refiner_preset,
)
from pointsplat_ns.refinement.weights import shipped_refiner
from pointsplat_ns.scene.checkpoints import load_checkpoint
from pointsplat_ns.scene.discovery import find_runs_and_plys, shown_scene
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import METHOD_NAMES, Run, open_run
from pointsplat_ns.system.files import one_line

SHIPPED = "shipped"
"""Name of the shipped refiner, in place of a path."""


@dataclass(frozen=True, eq=False)
class TrainedRefiner:
    """A trained network that refines pruned scenes, with the pruning settings of its training
    scenes.

    Example:
        >>> import pointsplat_ns as ps
        >>> refiner = ps.load_refiner()
        >>> refiner.settings.by, refiner.settings.keep
        ('merge', 0.1)
    """

    network: Refiner
    settings: PruneSettings
    source: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of ``ns-train pointsplat`` that the network was built with, as far as recorded."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.network}, for {self.settings.by} {self.settings.keep})"

    @torch.no_grad()
    def __call__(self, scene: Gaussians, kept: float | None = None) -> Gaussians:
        """The refined scene, on the device of the given one.

        Args:
            scene: K Gaussians.
            kept: number of Gaussians as a share of the dense scene's, in (0, 1]; by default the
                share of the training scenes, or a tenth if their budget is not a share.

        Raises:
            SceneError: if the SH degree exceeds the network's.
        """
        if kept is None:
            kept = self.settings.keep if self.settings.keep <= 1 else 0.1
        return self.network(scene.to(self.device), kept=kept).to(scene.device)

    @property
    def device(self) -> torch.device:
        """Device of the network."""
        return self.network.device


def load_refiner(
    path: Path | str | None = None,
    device: torch.device | str | None = None,
    by: str | None = None,
) -> TrainedRefiner:
    """Load a trained refiner.

    Args:
        path: a ``.safetensors`` file, or a ``pointsplat`` run (its folder, ``config.yml`` or
            checkpoint); by default, or with "shipped", the shipped refiner for the method ``by``
            (pages in ``pointsplat_ns/refinement/pretrained`` describe the training).
        device: device of the network; by default CUDA if available, else the CPU.
        by: pruning method of the shipped refiner; by default "merge".

    Raises:
        WeightsError: if the file is missing, damaged or of another kind.
        SceneError: if ``path`` is not a ``pointsplat`` run.

    Example:
        >>> import pointsplat_ns as ps
        >>> refiner = ps.load_refiner()
        >>> len(refiner(ps.prune(ps.example_room()[::10], keep=500)))
        500
    """
    device = default_device() if device is None else device
    shipped = path is None or str(path) == SHIPPED
    path = shipped_refiner(by or "merge") if path is None or shipped else Path(path)
    if shipped and not path.is_file():
        raise WeightsError(
            f"{path}: the shipped refiner is missing; install the package again, or name another "
            "(--refiner RUN_OR_FILE)"
        )
    kind = path.suffix.lower()
    options: Mapping[str, Any]
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise WeightsError(
            f"{path}: not a regular file; expected a trained pointsplat run or a .safetensors file"
        )
    if kind == ".safetensors":
        network = read_refiner(path)
        metadata = options = read_metadata(path)
        try:
            settings = settings_from({"keep": 0.1, "by": "merge", **metadata})
        except (PointSplatError, KeyError, TypeError, ValueError, OverflowError) as error:
            raise WeightsError(
                f"{path}: metadata not understood ({one_line(error)}); train or download it again"
            ) from error
    elif path.is_file() and kind not in (".yml", ".yaml", ".ckpt"):
        raise WeightsError(
            f"{path}: a {kind or 'nameless'} file; expected a trained pointsplat run (its folder "
            "or config.yml), or a .safetensors file"
        )
    else:
        run = open_refiner_run(path, need_data=False)
        network, settings = _read_run(run)
        options = run.model_fields
    return TrainedRefiner(
        network=network.to(device).eval(), settings=settings, source=path, options=options
    )


def refine(
    scene: Gaussians, refiner: TrainedRefiner | None = None, kept: float | None = None
) -> Gaussians:
    """Refine a pruned scene by one forward pass of a trained network.

    The network was trained on scenes pruned with ``refiner.settings``.
    :func:`pointsplat_ns.compact` compares renders before it accepts the result.

    Args:
        scene: K Gaussians.
        refiner: from :func:`load_refiner`; by default the shipped one.
        kept: number of Gaussians as a share of the dense scene's, in (0, 1], for networks that
            refine scenes of several budgets; by default the share of the training scenes.

    Returns:
        K Gaussians on the device of the given scene.

    Raises:
        SceneError: if the SH degree exceeds the network's.

    Example:
        >>> import pointsplat_ns as ps
        >>> small = ps.prune(ps.example_room()[::10], keep="10%")
        >>> len(ps.refine(small, ps.load_refiner())) == len(small)
        True
    """
    return (refiner or load_refiner())(scene, kept)


def open_refiner_run(path: Path | str, need_data: bool, data: Path | str | None = None) -> Run:
    """The ``pointsplat`` run at a path; arguments as for
    :func:`~pointsplat_ns.scene.runs.open_run`. Raises SceneError if the run is missing, damaged or
    of another method."""
    run = open_run(path, need_data, data)
    if not run.is_refiner:
        raise SceneError(
            f"{path}: a run of the method {run.method_name or 'unknown'}; expected a "
            f"{METHOD_NAMES.refiner} run"
        )
    return run


def scenes_of_run(run: Run) -> tuple[dict[str, Path], str]:
    """Checkpoints and PLY files of the training scenes of a ``pointsplat`` run, by name, and the
    name of the scene for viewers and exporters. The run must be opened with its data. Raises
    SceneError if no scene is found."""
    runs, plys, reason = find_runs_and_plys(
        run.data, run.datamanager_fields.get("supervision", "auto")
    )
    scenes = {name: scene.checkpoint for name, scene in runs.items()} | plys
    if not scenes:
        raise SceneError(
            f"{run.config_path}: {reason or f'{run.data}: no Gaussians in it'}; put its scenes back"
        )
    return scenes, shown_scene(list(scenes), run.datamanager_fields.get("eval_scenes") or ())


def settings_from(saved: Mapping[str, Any]) -> PruneSettings:
    """Pruning settings from a run's model settings or a file's metadata. The opacity weight is
    ignored for methods without one. Raises KeyError for a missing setting, and other errors for an
    unusable one."""
    by = saved["by"]
    saved_weight = saved.get("opacity_weight")
    weight = None if saved_weight is None else float(saved_weight)
    keep = saved["keep"]
    keep = keep if isinstance(keep, str) else float(keep)
    return PruneSettings.of(keep, by, weight if method_named(by).weighs_opacity else None)


LATER_OPTIONS = ("enc_depths", "stem", "raw_inputs", "means_reach", "units", "norm")
"""Network options that earlier versions lack; None takes the value of the size."""

NETWORK_OPTIONS = ("encoder", "use_appearance", "use_position", *LATER_OPTIONS)
"""Options of ``ns-train pointsplat`` that define a network, in addition to the size."""


def network_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Network options of a run's model settings that override the preset of its size."""
    return {
        **{name: settings[name] for name in ("encoder", "use_appearance", "use_position")},
        **{name: settings[name] for name in LATER_OPTIONS if settings.get(name) is not None},
    }


def _read_run(run: Run) -> tuple[Refiner, PruneSettings]:
    """The network in the checkpoint of a ``pointsplat`` run, and its pruning settings."""
    try:
        network = Refiner(
            refiner_preset(run.model_fields["size"], **network_options(run.model_fields))
        )
        settings = settings_from(run.model_fields)
        state = load_checkpoint(run.checkpoint)["pipeline"]
        prefix = "_model.refiner."
        network.load_state_dict(
            {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}
        )
    except KeyError as error:
        raise SceneError(
            f"{run.config_path}: lacks {error}; expected a {METHOD_NAMES.refiner} run of this "
            "version"
        ) from error
    except PointSplatError as error:
        raise SceneError(f"{run.config_path}: {error}") from error
    except Exception as error:  # a damaged archive can raise nearly anything
        text = " ".join(str(error).split())[:160]
        raise SceneError(
            f"{run.checkpoint}: not a usable {METHOD_NAMES.refiner} checkpoint ({text})"
        ) from error
    return network, settings
