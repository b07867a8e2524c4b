"""Saves and reads refiners: safetensors files, with configuration and metadata in the header."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.refinement.config import RefinerConfig, RefinerConfigError
from pointsplat_ns.refinement.refiner import Refiner
from pointsplat_ns.system.files import one_line, require_memory, write_tensors

REFINER_FORMAT = "pointsplat-refiner/1"

SHIPPED_REFINER = Path(__file__).parent / "pretrained" / "refiner.safetensors"
"""The shipped refiner of merged scenes; ``CARD.md`` beside it describes its training and
results."""

SHIPPED_FOR_SELECTIONS = Path(__file__).parent / "pretrained" / "selection.safetensors"
"""The shipped refiner of scenes pruned by a score; ``SELECTION.md`` beside it describes it."""


def shipped_refiner(by: str = "merge") -> Path:
    """The shipped refiner for a pruning method: one for merged scenes, one for those of which the
    Gaussians with the highest scores are kept."""
    return SHIPPED_REFINER if by == "merge" else SHIPPED_FOR_SELECTIONS


class WeightsError(PointSplatError):
    """A file without a usable refiner."""


def save_refiner(
    refiner: Refiner, path: str | Path, metadata: dict[str, Any] | None = None
) -> None:
    """Write a refiner's configuration, parameters and running statistics, with metadata, which may
    be anything that JSON can hold: data, command, steps, results."""
    header = {
        "format": REFINER_FORMAT,
        "config": json.dumps(vars(refiner.config)),
        "metadata": json.dumps(metadata or {}),
    }
    write_tensors(path, refiner.state_dict(), header)


def read_refiner(path: str | Path, device: torch.device | str = "cpu") -> Refiner:
    """Read a refiner in evaluation mode from a file.

    The file is not trusted: its configuration and the names, shapes and types of its tensors are
    checked before memory is allocated. Raises WeightsError if the file is missing, damaged, of
    another kind, or its tensors do not fit.
    """
    path = Path(path)
    with opened_weights(path, REFINER_FORMAT, "refiner weights") as (file, header):
        if "config" not in header:
            raise WeightsError(
                f"{path}: lacks the entry 'config'; expected refiner weights, as save_refiner "
                "writes them"
            )
        try:
            config = RefinerConfig.from_dict(_json(header, "config", path))
        except RefinerConfigError as error:
            raise WeightsError(
                f"{path}: configuration not understood ({one_line(error)}); train or download it "
                "again"
            ) from error
        tensors = len(file.keys())
        layers = sum(config.enc_depths) + sum(config.dec_depths) + config.head_depth
        if layers > tensors:
            raise WeightsError(
                f"{path}: {tensors} tensors for {layers} layers; the file is damaged or of "
                "another version"
            )
        refiner = Refiner(config, device="meta")  # shapes that take no memory
        state = checked_tensors(file, refiner.state_dict(), path)
    refiner.to_empty(device="cpu").load_state_dict(state)
    return refiner.to(device).eval()


def checked_tensors(
    file: Any, expected: dict[str, torch.Tensor], path: Path
) -> dict[str, torch.Tensor]:
    """The tensors of an opened file. Their names, shapes and kinds of numbers are compared with
    ``expected`` before memory is allocated. Raises WeightsError if they do not fit, or are not
    finite."""
    names = sorted(file.keys())
    found = {name: file.get_slice(name) for name in names}
    wrong = [
        name
        for name in sorted({*expected, *found})
        if _shape(expected, name) != _shape(found, name)
    ]
    if wrong:
        raise WeightsError(
            f"{path}: {len(wrong)} tensors do not fit, first {wrong[0]}: found "
            f"{_shape(found, wrong[0])}, expected "
            f"{_shape(expected, wrong[0])}; the file is damaged or of another version"
        )
    for name, tensor in found.items():
        if (tensor.get_dtype() in ("F64", "F32", "F16", "BF16")) != expected[
            name
        ].is_floating_point():
            raise WeightsError(
                f"{path}: {name} is of type {tensor.get_dtype()}; the file is damaged"
            )
    require_memory(path, path.stat().st_size)
    state = {name: file.get_tensor(name) for name in names}
    bad = [name for name, value in state.items() if not value.float().isfinite().all()]
    if bad:
        raise WeightsError(
            f"{path}: {bad[0]} holds NaN or Inf; expected finite weights; train or download it "
            "again"
        )
    return state


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata of a file written by :func:`save_refiner`. Errors are those of
    :func:`read_refiner`."""
    path = Path(path)
    with opened_weights(path, REFINER_FORMAT, "refiner weights") as (_, header):
        return _json(header, "metadata", path)


@contextmanager
def opened_weights(
    path: Path, expected_format: str, what: str
) -> Iterator[tuple[Any, dict[str, str]]]:
    """Open a file of weights, and read its header only: the opened file, and the texts of its
    header. ``what`` is the noun for its content in errors. Raises WeightsError if the file is
    missing, damaged or of another kind than ``expected_format``."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise WeightsError(f"{path}: no such file; expected {what} (.safetensors)")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            found = header.get("format")
            if found != expected_format:
                raise WeightsError(
                    f"{path}: not {what}: format {found!r}; expected {expected_format!r}"
                )
            yield file, header
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(
            f"{path}: not a readable safetensors file ({one_line(error)}); train or download it "
            "again"
        ) from error


def _json(header: dict[str, str], key: str, path: Path) -> dict[str, Any]:
    """The JSON object of an entry of the header; empty if there is none."""
    try:
        value = json.loads(header.get(key, "{}"))
    except (ValueError, RecursionError) as error:
        raise WeightsError(
            f"{path}: {key} is not JSON ({one_line(error)}); train or download it again"
        ) from error
    if isinstance(value, dict):
        return value
    raise WeightsError(
        f"{path}: {key} is {type(value).__name__}; expected a JSON object; train or download it "
        "again"
    )


def _shape(tensors: dict[str, Any], name: str) -> tuple[int, ...] | str:
    """The shape of a tensor, or of an unread tensor in a file."""
    if name not in tensors:
        return "nothing"
    tensor = tensors[name]
    return tuple(tensor.shape if isinstance(tensor, torch.Tensor) else tensor.get_shape())
