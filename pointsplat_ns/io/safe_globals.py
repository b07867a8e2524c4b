"""Lets torch load checkpoints of Splatfacto and of 3D Gaussian Splatting with ``weights_only=True``.

torch then unpickles only tensors and plain values, but every Splatfacto checkpoint holds a numpy float64 scalar in the
state of its schedulers, and one of 3D Gaussian Splatting such a scalar, of either precision, in its optimiser. The
functions registered here rebuild such a scalar from its bytes; they cannot run code from the file.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch


def allow_splatfacto_checkpoints() -> None:
    """Register numpy's float64 and float32 scalars with torch's ``weights_only`` loader.

    Calling it again changes nothing.
    """
    # numpy 2 renamed the module.
    scalar = importlib.import_module(f"numpy.{'_core' if hasattr(np, '_core') else 'core'}.multiarray").scalar
    allowed: list[Any] = [np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32))]
    # A checkpoint may come from the other major version of numpy, so register the function under both names.
    allowed += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    present = torch.serialization.get_safe_globals()
    torch.serialization.add_safe_globals([entry for entry in allowed if entry not in present])
