"""Files that a training of the refiner and its evaluation write. nerfstudio is not imported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import read_text

REFINER_NAME = "refiner.safetensors"
"""File of the trained network in the run's folder, for ``pointsplat compact --refiner``."""

VARIANTS = ("dense", "pruned", "refined")
"""The variants of each scene that an evaluation compares."""


def read_evaluation(path: Path) -> dict[str, Any]:
    """The results in a file that ``ns-eval`` wrote for a pointsplat run; a DataError if it is none."""
    try:
        results = json.loads(read_text(path))["results"]
        _check(results)
        json.dumps(results, ensure_ascii=False).encode("utf-8")  # halves of characters could not be shown
        return results
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected what ns-eval wrote") from error
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(f"{path}: not an evaluation of a pointsplat run; expected what ns-eval wrote") from error


def _check(results: dict[str, Any]) -> None:
    """Check all that :mod:`~pointsplat_ns.nerfstudio_plugin.pointsplat.report` shows. Errors are those of Python where
    something is missing or of another type."""
    blocks = list(results["scenes"].values())
    if not blocks:
        raise ValueError("no scene")
    for scene in blocks:
        scene["seen_in_training"]
    results.get("settings", {}).get("keep")
    other = results.get("against_dense_renders")
    parts = [results] if other is None else [results, other]
    for part in parts:
        blocks += [part[name] for name in ("average", "average_seen", "average_unseen") if name in part]
    for block in blocks:
        for value in (
            block[variant][name]
            for variant in VARIANTS
            for name in ("psnr", "ssim", "lpips", "gaussians", "megabytes", "fps")
        ):
            if value is not None:
                float(value + 0)  # a text has no sum with a number, and 10^400 is no float
    for part in [*parts, *results["scenes"].values()]:
        if not isinstance(part.get("reference", ""), str):
            raise TypeError("reference")
