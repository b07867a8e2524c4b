"""Saves and reads refiners: safetensors files, with configuration and metadata in the header."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.io.files import replacing
from pointsplat_ns.refiner.config import RefinerConfig, RefinerConfigError
from pointsplat_ns.refiner.refiner import Refiner

FORMAT = "pointsplat-refiner/1"

PRETRAINED = Path(__file__).parent / "pretrained" / "refiner.safetensors"
"""The refiner that ships; ``CARD.md`` beside it describes its training and results."""


class WeightsError(PointSplatError):
    """A file that does not hold a usable refiner."""


def save_refiner(refiner: Refiner, path: str | Path, metadata: dict[str, Any] | None = None) -> None:
    """Write a refiner's configuration, parameters and running statistics.

    Args:
        refiner: on any device, of any floating type.
        path: file to write or replace; its folder is created if missing.
        metadata: anything JSON can hold: data, command, steps, results.
    """
    from safetensors.torch import save_file

    header = {
        "format": FORMAT,
        "config": json.dumps(refiner.config.to_dict()),
        "metadata": json.dumps(metadata or {}),
    }
    state = {name: value.detach().cpu().contiguous() for name, value in refiner.state_dict().items()}
    with replacing(path) as part:
        save_file(state, part, metadata=header)


def read_refiner(path: str | Path, device: torch.device | str = "cpu") -> Refiner:
    """Read a refiner from a file; it is in evaluation mode.

    Raises:
        WeightsError: if the file is missing, damaged, of another kind, or its tensors do not fit.
    """
    path = Path(path)
    header, state = _read(path)
    try:
        config = RefinerConfig.from_dict(json.loads(header["config"]))
    except (RefinerConfigError, json.JSONDecodeError, KeyError, AttributeError, TypeError) as error:
        raise WeightsError(f"{path}: configuration not understood ({error}); train or download it again") from error
    bad = [name for name, value in state.items() if value.is_floating_point() and not value.isfinite().all()]
    if bad:
        raise WeightsError(f"{path}: {bad[0]} holds NaN or Inf; expected finite weights; train or download it again")
    refiner = Refiner(config)
    expected = refiner.state_dict()
    wrong = [n for n in sorted(expected.keys() | state.keys()) if _shape(expected, n) != _shape(state, n)]
    if wrong:
        name = wrong[0]
        raise WeightsError(
            f"{path}: {len(wrong)} tensors do not fit, first {name}: found {_shape(state, name)}, expected "
            f"{_shape(expected, name)}; the file is damaged or of another version"
        )
    refiner.load_state_dict(state)
    return refiner.to(device).eval()


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The metadata that was given to :func:`save_refiner`.

    Raises:
        WeightsError: if the file is missing, damaged or of another kind.
    """
    header, _ = _read(Path(path))
    return json.loads(header.get("metadata", "{}"))


def _read(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise WeightsError(f"{path}: no such file; expected refiner weights (.safetensors)")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise WeightsError(
                    f"{path}: format {header.get('format')!r}; expected {FORMAT!r}, as save_refiner writes it"
                )
            return header, {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file ({error}); train or download it again") from error


def _shape(state: dict[str, torch.Tensor], name: str) -> tuple[int, ...] | str:
    return tuple(state[name].shape) if name in state else "nothing"
