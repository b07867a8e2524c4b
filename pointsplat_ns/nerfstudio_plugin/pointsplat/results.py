"""Files that a training of the refiner and its evaluation write. nerfstudio is not imported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import DataError

REFINER_NAME = "refiner.safetensors"
"""File of the trained network in the run's folder, for ``pointsplat compact --refiner``."""

VARIANTS = ("dense", "pruned", "refined")
"""The variants of each scene that an evaluation compares."""


def read_evaluation(path: Path) -> dict[str, Any]:
    """The results in a file that ``ns-eval`` wrote for a pointsplat run.

    Raises:
        DataError: if the file is missing or is not such an evaluation.
    """
    try:
        results = json.loads(path.read_text("utf-8"))["results"]
        assert set(VARIANTS) <= set(next(iter(results["scenes"].values())))
        return results
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected what ns-eval wrote") from error
    except (ValueError, KeyError, TypeError, AttributeError, AssertionError, StopIteration) as error:
        raise DataError(f"{path}: not an evaluation of a pointsplat run; expected what ns-eval wrote") from error
