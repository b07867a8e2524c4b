"""Settings of a resumed training: those that it does not name are those of its checkpoint's run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.pipeline.trained_refiner import NETWORK_OPTIONS
from pointsplat_ns.scene.inert_yaml import Tagged, read_config
from pointsplat_ns.scene.runs import RUN_FILES
from pointsplat_ns.system.processes import rank

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig

SELECTION = ("keep", "more_keeps", "by", "opacity_weight")
"""Settings that say how scenes are pruned. They are taken together, or none of them."""


def take_settings_of(
    checkpoint: Path, model: PointSplatModelConfig, usual: PointSplatModelConfig
) -> None:
    """Give ``model`` the settings of the run that a checkpoint lies in, where it has the ``usual``
    ones: all options of the network, and how scenes are pruned if nothing of that is set. A
    checkpoint outside of a run changes nothing.

    Raises:
        PointSplatError: if an option of the network is set to another value than the run's.
    """
    saved = _model_settings(checkpoint)
    taken = {}
    for name in ("size", *NETWORK_OPTIONS):
        given = getattr(model, name, None)
        if name not in saved or saved[name] == given:
            continue
        if given != getattr(usual, name):
            raise PointSplatError(
                f"--pipeline.model.{name.replace('_', '-')} {given}: {checkpoint} holds a network "
                f"with {saved[name]}; leave the option out, or begin without the checkpoint"
            )
        taken[name] = saved[name]
    if all(getattr(model, name) == getattr(usual, name) for name in SELECTION):
        taken |= {n: saved[n] for n in SELECTION if n in saved and saved[n] != getattr(model, n)}
    for name, value in taken.items():
        setattr(model, name, value)
    if taken and rank() == 0:
        text = ", ".join(f"{name.replace('_', '-')} {value}" for name, value in taken.items())
        log(f"from the run of {checkpoint}: {text}")


def _model_settings(checkpoint: Path) -> dict[str, Any]:
    """Settings of the model in the ``config.yml`` of a checkpoint's run; none without one."""
    path = checkpoint.absolute().parents[1] / RUN_FILES.config
    if not path.is_file():
        return {}
    pipeline = read_config(path).fields.get("pipeline")
    model = pipeline.fields.get("model") if isinstance(pipeline, Tagged) else None
    if not isinstance(model, Tagged):
        raise SceneError(f"{path}: not a trainer configuration; lacks the object 'model'")
    return {name: value for name, value in model.fields.items() if not isinstance(value, Tagged)}
