"""Opens trained nerfstudio runs: checkpoint, settings, data folder and coordinate frame.

nerfstudio saves a run in ``outputs/EXPERIMENT/METHOD/TIMESTAMP``, with ``config.yml``,
``dataparser_transforms.json`` and ``nerfstudio_models/step-*.ckpt``. Everything is read without
importing nerfstudio and without executing ``config.yml``.
"""

from __future__ import annotations

import json
import math
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.checkpoints import is_complete
from pointsplat_ns.scene.inert_yaml import Tagged, read_config
from pointsplat_ns.system.files import file_stem, logger, one_line, read_text
from pointsplat_ns.system.tensors import FLOATS


@dataclass(frozen=True)
class RunFiles:
    """Names of files in the folder of a run."""

    config: str = "config.yml"
    transforms: str = "dataparser_transforms.json"
    """Transform from the frame of the dataset's poses to that of the scene."""
    refiner: str = "refiner.safetensors"
    """Weights of the refiner trained by the run."""


RUN_FILES = RunFiles()


@dataclass(frozen=True)
class MethodNames:
    """Names of this package's methods in nerfstudio."""

    scene: str = "splatfacto-cpu"
    """Trains scenes."""
    refiner: str = "pointsplat"
    """Trains refiners; presets append a hyphen and a name."""


METHOD_NAMES = MethodNames()


@dataclass(frozen=True, eq=False)
class Run:
    """A trained nerfstudio run. Settings come from ``config.yml``; nested objects are
    :class:`~pointsplat_ns.scene.inert_yaml.Tagged`."""

    folder: Path
    config_path: Path
    checkpoint: Path
    """The newest complete checkpoint, or the requested one."""
    step: int
    method_name: str
    experiment_name: str
    """As configured; empty or "unnamed" if the user gave none."""
    timestamp: str
    data: Path
    """Training data of the run: an existing path if :func:`open_run` was called with ``need_data``,
    else the configured path."""
    dataparser_class: str
    """Dotted name of the dataparser's configuration class."""
    dataparser_fields: dict[str, Any]
    datamanager_fields: dict[str, Any]
    model_fields: dict[str, Any]
    transform: Tensor  # [3, 4] float32, data world to scene, before the scale
    scale: float
    """Scene units per unit of the transformed data."""

    @property
    def is_refiner(self) -> bool:
        """Whether the checkpoint holds a refiner for many scenes."""
        return self.method_name == METHOD_NAMES.refiner or self.method_name.startswith(
            f"{METHOD_NAMES.refiner}-"
        )

    @property
    def is_gaussian_scene(self) -> bool:
        """Whether the checkpoint holds one Gaussian scene: Splatfacto or a derived method."""
        if self.is_refiner:
            return False
        # Methods derived from Splatfacto also have these settings.
        needed = {"sh_degree", "densify_grad_thresh", "rasterize_mode"}
        return self.method_name.startswith("splatfacto") or self.model_fields.keys() >= needed

    @property
    def rasterize_mode(self) -> Literal["classic", "antialiased"]:
        """Rasterize mode of the run's training."""
        return (
            "antialiased" if self.model_fields.get("rasterize_mode") == "antialiased" else "classic"
        )


def may_be_run(path: Path | str) -> bool:
    """Whether a path can be a run: a folder, a checkpoint or YAML. All other files are scenes."""
    path = Path(path)
    return path.is_dir() or path.suffix.lower() in (".ckpt", ".yml", ".yaml")


def open_run(path: Path | str, need_data: bool = True, data: Path | str | None = None) -> Run:
    """The run at ``path``.

    Args:
        path: the run's folder, its ``config.yml``, or one of its checkpoints, which is then used.
        need_data: whether to search for the training data. A relative path is tried from the
            current folder, then from the run's folder and every folder above it.
        data: where the data is now, if it moved: the data itself, or a folder above it. Below that
            folder, the last parts of the configured path are searched for.

    Raises:
        SceneError: if ``path`` is not a run, has no complete checkpoint, or its data is needed and
            missing.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path}: no such file or folder; expected a nerfstudio run")
    if not may_be_run(path):
        raise SceneError(
            f"{path}: not a nerfstudio run; expected its folder, its {RUN_FILES.config} or a "
            "checkpoint"
        )
    chosen = path if path.suffix == ".ckpt" else None
    folder = path if path.is_dir() else path.parent
    if chosen is not None and not (folder / RUN_FILES.config).is_file():
        folder = folder.parent
    config_path = path if path.is_file() and chosen is None else folder / RUN_FILES.config
    if not config_path.is_file():
        raise SceneError(
            f"{path}: not a nerfstudio run; expected a folder with {RUN_FILES.config} (no "
            f"{config_path})"
        )
    root = read_config(config_path)
    pipeline = _tagged(root, "pipeline", config_path)
    datamanager = _tagged(pipeline, "datamanager", config_path)
    model = _tagged(pipeline, "model", config_path)
    # Runs of some other methods have no dataparser.
    dataparser = datamanager.fields.get("dataparser")
    dataparser = dataparser if isinstance(dataparser, Tagged) else Tagged("", {})
    checkpoint, step = _checkpoint(folder, root.fields.get("relative_model_dir"), chosen)
    candidates = (
        datamanager.fields.get("data"),
        dataparser.fields.get("data"),
        root.fields.get("data"),
    )
    named = next(
        (
            Path(value)
            for value in candidates
            if isinstance(value, (str, Path)) and str(value) != "."
        ),
        Path(),
    )
    found = _found_data(named, folder, config_path, data) if need_data else named
    transform, scale = read_transforms(folder / RUN_FILES.transforms)
    return Run(
        folder=folder,
        config_path=config_path,
        checkpoint=checkpoint,
        step=step,
        method_name=str(root.fields.get("method_name") or ""),
        experiment_name=str(root.fields.get("experiment_name") or ""),
        timestamp=str(root.fields.get("timestamp") or ""),
        data=found,
        dataparser_class=dataparser.tag,
        dataparser_fields=_settings(dataparser, "data"),
        datamanager_fields=_settings(datamanager, "data", "dataparser"),
        model_fields=_settings(model),
        transform=transform,
        scale=scale,
    )


def scene_name(run: Run) -> str:
    """A short scene name that is valid as a file name: the experiment's, or else the data
    folder's."""
    name = run.experiment_name if run.experiment_name != "unnamed" else ""
    data = run.data.parent if run.data.suffix else run.data
    return file_stem(name or data.name or run.folder.name)


def name_of(path: Path) -> str:
    """Scene name of a path, valid as a file name: that of its run, or else of its file."""
    with suppress(SceneError):  # not a run
        return scene_name(open_run(path, need_data=False))
    return file_stem(path.stem)


def _tagged(parent: Tagged, name: str, path: Path) -> Tagged:
    value = parent.fields.get(name)
    if not isinstance(value, Tagged):
        raise SceneError(f"{path}: not a trainer configuration; lacks the object {name!r}")
    return value


def _settings(config: Tagged, *without: str) -> dict[str, Any]:
    """Fields of a configuration object, except names that begin with ``_`` and those in
    ``without``."""
    return {
        key: value
        for key, value in config.fields.items()
        if not str(key).startswith("_") and key not in without
    }


def step_of(checkpoint: Path) -> int | None:
    """The training step in a checkpoint's name, ``step-N.ckpt``; None for any other name."""
    match = re.fullmatch(r"step-(\d{1,18})\.ckpt", checkpoint.name)
    return int(match[1]) if match else None


def _checkpoint(folder: Path, configured: Any, chosen: Path | None) -> tuple[Path, int]:
    """The checkpoint to use and its step."""
    if chosen is not None:
        return chosen, step_of(chosen) or 0
    place = folder / "nerfstudio_models"
    if (
        isinstance(configured, Path)
        and not configured.is_absolute()
        and (folder / configured).is_dir()
    ):
        place = folder / configured
    steps = {
        step: file for file in place.glob("step-*.ckpt") if (step := step_of(file)) is not None
    }
    for step in sorted(steps, reverse=True):
        if is_complete(steps[step]):
            return steps[step], step
        logger.warning("%s: not a complete checkpoint; trying an older one", steps[step])
    checkpoints = f"{len(steps)} incomplete" if steps else "none"
    raise SceneError(
        f"{folder}: no complete checkpoint in {place.name} ({checkpoints}); let the training "
        "reach its first save"
    )


def _found_data(named: Path, folder: Path, config_path: Path, place: Path | str | None) -> Path:
    """The data of the run on this machine. Tries the configured path from the current folder and
    from the run's folder and those above; or at or below ``place``, with as many last parts of the
    configured path as possible."""
    if named == Path() and place is None:
        raise SceneError(
            f"{config_path}: names no data folder; expected the photos that the run was trained on"
        )
    if place is not None:
        names = [name for name in named.parts if name not in (named.anchor, "..", "~")]
        tried = [Path(place, *names[first:]) for first in range(len(names) + 1)]
    else:
        with suppress(RuntimeError):  # "~nobody": unknown user
            named = named.expanduser()
        home = folder.resolve()
        tried = list(dict.fromkeys(above / named for above in (Path.cwd(), home, *home.parents)))
    for candidate in tried:
        with suppress(OSError):  # name too long, or folder not readable
            if candidate.exists():
                return candidate
    if place is not None:
        raise SceneError(
            f"{place}: no such folder; expected the data of {config_path}, once at {named}, or a "
            "folder above"
        )
    places = ", ".join(map(str, tried[:3])) + (
        f" and {len(tried) - 3} more above" if len(tried) > 3 else ""
    )
    raise SceneError(
        f"{config_path}: its data {named} is missing; tried {places}; pass its folder with --data "
        "DIR, or move the data back"
    )


def read_transforms(path: Path) -> tuple[Tensor, float]:
    """The transform (3, 4) and the scale of a ``dataparser_transforms.json``; identity and 1 if the
    file is missing. Raises SceneError if it has another content."""
    if not path.is_file():
        return torch.eye(4, **FLOATS)[:3], 1.0
    try:
        content = json.loads(read_text(path, 1 << 16))  # nerfstudio writes some hundreds of bytes
        transform = torch.tensor(content["transform"], **FLOATS)
        scale = float(content["scale"])
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        OverflowError,
        RecursionError,
        RuntimeError,
    ) as error:
        why = f"lacks {error}" if isinstance(error, KeyError) else one_line(error, 80)
        raise SceneError(
            f"{path}: not a dataparser transform ({why}); expected 'transform' (3 x 4) and 'scale'"
        ) from error
    if (
        transform.shape != (3, 4)
        or not transform.isfinite().all()
        or not (math.isfinite(scale) and scale > 0)
    ):
        raise SceneError(
            f"{path}: transform of shape {tuple(transform.shape)}, scale {scale}; "
            "expected 3 x 4 finite numbers and a positive scale"
        )
    return transform, scale
