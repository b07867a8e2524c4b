"""Splatfacto checkpoints (``nerfstudio_models/step-*.ckpt``)."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any, TypeGuard

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.io.files import keep_usable, one_line, require_file, require_memory
from pointsplat_ns.io.safe_globals import allow_splatfacto_checkpoints


def read_checkpoint(path: Path | str) -> Gaussians:
    """Read the scene of a Splatfacto checkpoint.

    Loads with ``weights_only=True``: a checkpoint cannot run code. At SH degree 0, where Splatfacto stores colours as
    logits, they are converted to SH coefficients of the same colour. Gaussians that cannot be drawn (NaN, or Inf where
    it is not valid) are dropped, and their number is logged.

    Returns:
        The scene, float32 on the CPU, in the frame of the run's dataparser.

    Raises:
        SceneError: if the file is truncated, is no checkpoint, or is one of another method.
    """
    path = require_file(path, "a Splatfacto checkpoint")
    state = _pipeline_state(_load(path), path)
    # Of current versions, and of those before nerfstudio 1.0, each also with the wrapper of distributed training.
    prefixes = ("_model.gauss_params.", "_model.module.gauss_params.", "_model.", "_model.module.")
    prefix = next((p for p in prefixes if f"{p}means" in state), None)
    if prefix is None:
        keys = sorted(str(key) for key in state)
        shown = ", ".join(keys[:4]) + (f" and {len(keys) - 4} more" if len(keys) > 4 else "")
        raise SceneError(
            f"{path}: a checkpoint of another method; found the keys {shown or 'none'}; "
            f"expected {prefixes[0]}means, as Splatfacto saves"
        )
    limit = path.stat().st_size
    held = (state.get(prefix + name) for name in PARAMETERS)
    require_memory(path, min(limit, sum(4 * value.numel() for value in held if _is_dense(value))))
    tensors = [_parameter(state, prefix + name, path, limit) for name in PARAMETERS]
    try:
        scene = Gaussians(*tensors)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    if scene.sh_degree == 0:
        scene = scene.replace(features_dc=(torch.sigmoid(scene.features_dc) - 0.5) / SH_C0)
    return keep_usable(scene, path)


def is_complete(path: Path) -> bool:
    """Whether a checkpoint's archive is complete, that is, has the directory at its end."""
    try:
        return path.is_file() and zipfile.is_zipfile(path)
    except (OSError, zipfile.BadZipFile):  # of an archive in several parts
        return False


def _load(path: Path) -> Any:
    """Load a checkpoint, with its tensors memory-mapped if it is an archive."""
    expected = "expected a checkpoint that Splatfacto saved"
    if path.stat().st_size == 0:
        raise SceneError(f"{path}: the file is empty; {expected}")
    archive = is_complete(path)
    if not archive and path.open("rb").read(2) == b"PK":
        raise SceneError(f"{path}: truncated, the archive has no end; {expected}; train or copy it again")
    allow_splatfacto_checkpoints()
    try:
        if archive:
            with zipfile.ZipFile(path) as content:
                if sum(entry.file_size for entry in content.infolist()) > path.stat().st_size:
                    raise SceneError(f"{path}: a compressed archive; {expected}")
        return torch.load(path, map_location="cpu", weights_only=True, mmap=archive)
    except SceneError:
        raise
    except Exception as error:  # a damaged pickle can raise nearly anything
        foreign = re.search(r"GLOBAL ([\w.]+)", str(error))
        if foreign:
            raise SceneError(
                f"{path}: holds an object of type {foreign[1]}, which only running its code could load; {expected}"
            ) from error
        raise SceneError(
            f"{path}: truncated or not a checkpoint ({type(error).__name__}: {one_line(error, 100)}); {expected}"
        ) from error


def _pipeline_state(content: Any, path: Path) -> dict[str, Any]:
    state = content.get("pipeline") if isinstance(content, dict) else None
    if not isinstance(state, dict):
        found = (
            ", ".join(str(key) for key in list(content)[:6]) if isinstance(content, dict) else type(content).__name__
        )
        raise SceneError(
            f"{path}: not a nerfstudio checkpoint; found {found or 'no keys'}, expected the key 'pipeline'"
        )
    return state


def _is_dense(value: Any) -> TypeGuard[Tensor]:
    """Whether a value is a tensor of plain numbers: not one that is nested, sparse, quantised or without content."""
    return (
        isinstance(value, Tensor)
        and not value.is_nested
        and (value.dtype, value.layout, value.device.type)
        in {(dtype, torch.strided, "cpu") for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64)}
    )


def _parameter(state: dict[str, Any], key: str, path: Path, limit: int) -> Tensor:
    """A float32 copy of one parameter, independent of the mapped file."""
    value = state.get(key)
    if value is None:
        raise SceneError(f"{path}: lacks the key {key!r}; expected a Splatfacto checkpoint")
    if not _is_dense(value):
        kind = f"{value.dtype} {value.layout} on {value.device}" if isinstance(value, Tensor) else type(value).__name__
        raise SceneError(f"{path}: {key!r} is {kind}; expected a dense floating-point tensor")
    if value.numel() * value.element_size() > limit:
        raise SceneError(f"{path}: {key!r} has shape {tuple(value.shape)}, more than the file can hold")
    return value.detach().to(torch.float32, copy=True, memory_format=torch.contiguous_format)
