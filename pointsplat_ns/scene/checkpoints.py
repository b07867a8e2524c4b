"""Reads checkpoints of Splatfacto (``step-*.ckpt``), gsplat (``ckpts/ckpt_*_rank0.pt``) and 3DGS
(``chkpnt*.pth``)."""

from __future__ import annotations

import importlib
import re
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.checkpoint_pickles import PickleRefused, need_bounded
from pointsplat_ns.scene.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.scene.moving import refuse_moving
from pointsplat_ns.system.files import (
    logger,
    one_line,
    read_text,
    require_file,
    require_memory,
)
from pointsplat_ns.system.opening import open_regular

EXPECTED = "expected a checkpoint that Splatfacto, gsplat or 3DGS saved"

_INRIA_ENTRIES = 12
"""Entries of the model in a checkpoint of 3DGS: SH degree, six parameters, three statistics, the
optimiser, and the scale of learning rates."""


def read_checkpoint(path: Path | str) -> Gaussians:
    """Read the scene of a checkpoint of Splatfacto, of gsplat's trainer, or of INRIA's 3DGS.

    Loads with ``weights_only=True``: a checkpoint cannot run code. At SH degree 0, Splatfacto
    stores colours as logits; they are converted to SH coefficients of the same colour. For gsplat,
    the training's ``cfg.yml`` decides whether the scene is antialiased, and the parts of a training
    on several GPUs are joined, whichever is named.

    Returns:
        The scene, float32 on the CPU, in the training's frame: for Splatfacto, the frame of the
        run's dataparser.

    Raises:
        SceneError: if the file is truncated, is not a checkpoint, belongs to another method or a
            moving scene, or is one of several parts of which others are missing.
    """
    path = require_file(path, "a checkpoint")
    parts = checkpoint_parts(path)
    if len(parts) > 1:
        logger.info(
            "%s: one of %d parts of a training on several GPUs, which are joined", path, len(parts)
        )
        return _joined([_read_part(part) for part in parts], path)
    return _read_part(path)


def checkpoint_parts(path: Path) -> list[Path]:
    """All files of a checkpoint of gsplat: of a training on several GPUs one per GPU. Raises
    SceneError if one of them is missing."""
    named = re.fullmatch(r"(ckpt_\d+_rank)(\d{1,4})\.pt", path.name)
    if named is None:
        return [path]
    ranks = {int(named[2])}
    for other in path.parent.glob(f"{named[1]}*.pt"):
        if rank := re.fullmatch(r"(\d{1,4})\.pt", other.name.removeprefix(named[1])):
            ranks.add(int(rank[1]))
    parts = [path.with_name(f"{named[1]}{rank}.pt") for rank in range(max(ranks) + 1)]
    missing = [part.name for part in parts if not part.is_file()]
    if missing:
        raise SceneError(
            f"{path}: one of at least {len(parts)} parts of a training on several GPUs; expected "
            f"all of them beside it; {missing[0]} is missing"
        )
    return parts


def _joined(parts: list[Gaussians], path: Path) -> Gaussians:
    degrees = {part.sh_degree for part in parts}
    if len(degrees) > 1:
        raise SceneError(
            f"{path}: the parts of its training have SH of degrees {sorted(degrees)}; expected one"
        )
    return Gaussians.cat(parts)


def _read_part(path: Path) -> Gaussians:
    """The scene of one file."""
    content = load_checkpoint(path)
    if isinstance(content, tuple) and len(content) == 2 and isinstance(content[0], tuple):
        return _scene_of_inria(content[0], path)
    # gsplat's simple_trainer
    if isinstance(content, dict) and isinstance(content.get("splats"), dict):
        scene = _scene_of_gsplat(content["splats"], path)
        return scene.replace(antialiased=_gsplat_antialiased(path))
    state = _pipeline_state(content, path)
    # Current versions, then those before nerfstudio 1.0; each also with the wrapper of distributed
    # training.
    prefixes = ("_model.gauss_params.", "_model.module.gauss_params.", "_model.", "_model.module.")
    prefix = next((p for p in prefixes if f"{p}means" in state), None)
    if prefix is None:
        raise SceneError(
            f"{path}: a checkpoint of another method; found the keys {_some(state, 4)}; "
            f"expected {prefixes[0]}means, as Splatfacto saves"
        )
    scene = _scene_of(
        {name: (prefix + name, state.get(prefix + name)) for name in PARAMETERS}, path
    )
    if scene.sh_degree == 0:
        scene = scene.replace(features_dc=(torch.sigmoid(scene.features_dc) - 0.5) / SH_C0)
    return scene


def _gsplat_antialiased(path: Path) -> bool:
    """Whether gsplat's ``cfg.yml``, above the checkpoint's folder, sets antialiased rendering;
    False if there is no such file."""
    try:
        text = read_text(path.absolute().parents[1] / "cfg.yml", 1 << 20)
    except (OSError, ValueError, IndexError):
        return False
    return re.search(r"^antialiased: true\s*$", text, re.M) is not None


def _scene_of_gsplat(splats: dict[str, Any], path: Path) -> Gaussians:
    """The scene of gsplat's parameters: opacities (N,), constant SH coefficients (N, 1, 3)."""
    refuse_moving((key for key in splats if isinstance(key, str)), path)
    keys = dict(zip(PARAMETERS, PARAMETERS, strict=True)) | {
        "features_dc": "sh0",
        "features_rest": "shN",
    }
    held = {name: splats.get(key) for name, key in keys.items()}
    if isinstance(opacities := held["opacities"], Tensor) and opacities.dim() == 1:
        held["opacities"] = opacities[:, None]
    if isinstance(dc := held["features_dc"], Tensor) and dc.dim() == 3 and dc.shape[1] == 1:
        held["features_dc"] = dc[:, 0]
    return _scene_of({name: (key, held[name]) for name, key in keys.items()}, path)


def _scene_of_inria(model: tuple[Any, ...], path: Path) -> Gaussians:
    """The scene of what 3DGS and its relatives save: the SH degree, positions, constant (N, 1, 3)
    and other (N, K, 3) SH coefficients, log-scales, of 2DGS (N, 2), quaternions, opacity logits.

    4DGaussians has the state of its deformation among them, and 4D Gaussian Splatting times behind
    them.
    """
    if any(isinstance(entry, dict) for entry in model[:7]) or len(model) > _INRIA_ENTRIES + 2:
        raise SceneError(
            f"{path}: a checkpoint of a moving scene; export a PLY of one moment from the program "
            "that trained it"
        )
    if len(model) != _INRIA_ENTRIES:
        raise SceneError(
            f"{path}: a checkpoint of {len(model)} entries; expected {_INRIA_ENTRIES}, as 3DGS "
            "saves; name the point_cloud.ply of the training instead"
        )
    names = ("means", "features_dc", "features_rest", "scales", "quats", "opacities")
    held = dict(zip(names, model[1:7], strict=True))
    dc, scales = held["features_dc"], held["scales"]
    if isinstance(dc, Tensor) and dc.dim() == 3 and dc.shape[1] == 1:
        held["features_dc"] = dc[:, 0]
    if _is_dense(scales) and scales.dim() == 2 and scales.shape[1] == 2:
        held["scales"] = torch.nn.functional.pad(scales.detach(), (0, 1), value=-torch.inf)
    return _scene_of({name: (name, held[name]) for name in PARAMETERS}, path)


def _scene_of(values: dict[str, tuple[str, Any]], path: Path) -> Gaussians:
    """The scene of parameters, given with their keys; includes Gaussians that cannot be drawn."""
    limit = path.stat().st_size
    require_memory(
        path, min(limit, sum(4 * value.numel() for _, value in values.values() if _is_dense(value)))
    )
    tensors = {name: _parameter(value, key, path, limit) for name, (key, value) in values.items()}
    try:
        return Gaussians(*(tensors[name] for name in PARAMETERS))
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def _some(keys: Iterable[Any], count: int) -> str:
    """The first keys, and the number of the remaining ones."""
    names = sorted(str(key) for key in keys)
    return (", ".join(names[:count]) or "none") + (
        f" and {len(names) - count} more" if len(names) > count else ""
    )


@dataclass(frozen=True, eq=False)
class PhotoFit:
    """Per-photo parameters of a training, stored beside the scene."""

    adjustments: Tensor | None
    """(C, 6) float32: pose correction of each training photo, a translation in scene units and a
    rotation vector in radians; None if poses were not optimised."""
    colors: str
    """Key of parameters that change the colours of each photo, such as a bilateral grid; empty if
    there are none."""


def read_photo_fit(path: Path | str) -> PhotoFit:
    """Read the per-photo parameters of a Splatfacto checkpoint; loads as :func:`read_checkpoint`.

    Raises:
        SceneError: if the file is not a checkpoint, or its pose corrections are not (C, 6) finite
            numbers.
    """
    path = require_file(path, "a Splatfacto checkpoint")
    state = _pipeline_state(load_checkpoint(path), path)
    names = [key for key in state if isinstance(key, str)]
    key = next((name for name in names if name.endswith("camera_optimizer.pose_adjustment")), None)
    adjustments = None if key is None else _parameter(state[key], key, path, path.stat().st_size)
    if adjustments is not None and not (
        adjustments.dim() == 2 and adjustments.shape[1] == 6 and bool(adjustments.isfinite().all())
    ):
        raise SceneError(
            f"{path}: {key!r} of shape {tuple(adjustments.shape)}; expected six finite numbers "
            "for each training photo"
        )
    words = re.compile(r"bil_?grid|bilateral|appearance|embed|exposure")
    colors = next(
        (name for name in sorted(names) if name.startswith("_model.") and words.search(name)), ""
    )
    return PhotoFit(adjustments, colors)


def read_training_state(path: Path) -> dict[str, Any]:
    """Everything that resuming a nerfstudio training needs from its checkpoint; tensors are not
    memory-mapped. Loads as :func:`read_checkpoint`.

    Raises:
        SceneError: if the file is truncated, or lacks the step, the pipeline or the optimisers.
    """
    expected = "expected a checkpoint of a nerfstudio training"
    content = load_checkpoint(path, mapped=False)
    found = _some(content, 6) if isinstance(content, dict) else type(content).__name__
    needed = {"step": int, "pipeline": dict, "optimizers": dict, "scalers": dict}
    for name, kind in needed.items():
        if not isinstance(content, dict) or not isinstance(content.get(name), kind):
            raise SceneError(
                f"{path}: training cannot resume; lacks {name!r}; found {found}; {expected}"
            )
    if content["step"] < 0:
        raise SceneError(f"{path}: its step is {content['step']}; {expected}")
    return content


def is_complete(path: Path) -> bool:
    """Whether a checkpoint's archive is complete: its directory, at the end, can be read."""
    try:
        with open_regular(path) as stream:
            return zipfile.is_zipfile(stream)
    except (OSError, zipfile.BadZipFile):  # an archive in several parts
        return False


def allow_splatfacto_checkpoints() -> None:
    """Allow numpy's float64 scalars in torch's ``weights_only`` loader.

    Splatfacto checkpoints hold such a scalar in the state of their schedulers, and those of 3DGS
    one as scale of learning rates, also as float32. The registered functions rebuild it from its
    bytes; they cannot run code from the file.
    """
    # numpy 2 renamed the module.
    scalar = importlib.import_module(
        f"numpy.{'_core' if hasattr(np, '_core') else 'core'}.multiarray"
    ).scalar
    allowed: list[Any] = [np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32))]
    # A checkpoint may come from the other major version of numpy, so register the function under
    # both names.
    allowed += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    present = torch.serialization.get_safe_globals()
    torch.serialization.add_safe_globals([entry for entry in allowed if entry not in present])


def load_checkpoint(path: Path, mapped: bool = True) -> Any:
    """Content of a checkpoint. Tensors are memory-mapped if it is an archive and ``mapped``. Runs
    no code of the file, and takes memory in proportion to its size.

    Raises:
        SceneError: if the file is not a checkpoint, is damaged, or takes more memory.
    """
    require_file(path, "a checkpoint")
    if path.stat().st_size == 0:
        raise SceneError(f"{path}: the file is empty; {EXPECTED}")
    archive = is_complete(path)
    allow_splatfacto_checkpoints()
    try:
        with open_regular(path) as stream:
            if not archive and stream.read(2) == b"PK":
                raise SceneError(
                    f"{path}: truncated, the archive has no end; {EXPECTED}; train or copy it again"
                )
        need_bounded(path)
        return torch.load(path, map_location="cpu", weights_only=True, mmap=archive and mapped)
    except SceneError:
        raise
    except Exception as error:  # a damaged pickle can raise nearly anything
        why = f"truncated or not a checkpoint ({type(error).__name__}: {one_line(error, 100)})"
        if foreign := re.search(r"GLOBAL ([\w.]+)", str(error)):
            why = f"holds an object of type {foreign[1]}, which no scene needs; not loaded"
        elif isinstance(error, PickleRefused):
            why = f"truncated or not a checkpoint: {one_line(error, 100)}"
        raise SceneError(f"{path}: {why}; {EXPECTED}") from error


def _pipeline_state(content: Any, path: Path) -> dict[str, Any]:
    state = content.get("pipeline") if isinstance(content, dict) else None
    if not isinstance(state, dict):
        found = _some(content, 6) if isinstance(content, dict) else type(content).__name__
        raise SceneError(
            f"{path}: not a checkpoint of a scene; found {found}; expected the key 'pipeline' of "
            "nerfstudio, or 'splats' of gsplat, or the tuple of 3DGS"
        )
    return state


def _is_dense(value: Any) -> TypeGuard[Tensor]:
    """Whether a value is a dense tensor: not nested, sparse, quantised or a meta tensor."""
    if not isinstance(value, Tensor) or value.is_nested:
        return False
    floats = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
    return value.dtype in floats and value.layout == torch.strided and value.device.type == "cpu"


def _parameter(value: Any, key: str, path: Path, limit: int) -> Tensor:
    """A float32 copy of one parameter, independent of the mapped file."""
    if value is None:
        raise SceneError(f"{path}: lacks the key {key!r}; {EXPECTED}")
    if not _is_dense(value):
        kind = (
            f"{value.dtype} {value.layout} on {value.device}"
            if isinstance(value, Tensor)
            else type(value).__name__
        )
        raise SceneError(f"{path}: {key!r} is {kind}; expected a dense floating-point tensor")
    if value.numel() * value.element_size() > limit:
        raise SceneError(
            f"{path}: {key!r} has shape {tuple(value.shape)}, more than the file can hold"
        )
    return value.detach().to(torch.float32, copy=True, memory_format=torch.contiguous_format)
