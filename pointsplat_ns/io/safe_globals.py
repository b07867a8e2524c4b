"""Lets torch load Splatfacto checkpoints with ``weights_only=True``.

By default torch 2.6 and later unpickle only tensors and plain values, but every Splatfacto checkpoint holds a numpy
float64 scalar in the state of its schedulers. The functions registered here rebuild such a scalar from its bytes; they
cannot run code from the file.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch


def allow_splatfacto_checkpoints() -> None:
    """Register numpy's float64 scalar with torch's ``weights_only`` loader.

    Calling it again changes nothing. Before torch 2.4, which has no such register, it does nothing.
    """
    add = getattr(torch.serialization, "add_safe_globals", None)
    if add is None:
        return
    # numpy 2 renamed the module.
    scalar = importlib.import_module(f"numpy.{'_core' if hasattr(np, '_core') else 'core'}.multiarray").scalar
    allowed: list[Any] = [np.dtype, type(np.dtype(np.float64))]
    if _torch_version() >= (2, 6):
        # A checkpoint may come from the other major version of numpy, so register the function under both names.
        allowed += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    else:
        allowed.append(scalar)
    present = torch.serialization.get_safe_globals()
    add([entry for entry in allowed if entry not in present])


def _torch_version() -> tuple[int, int]:
    major, minor = torch.__version__.split(".")[:2]
    return int(major), int("".join(c for c in minor if c.isdigit()) or 0)
