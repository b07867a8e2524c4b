"""Tells whether gsplat can render instead of this package."""

from __future__ import annotations

import functools

import torch

from pointsplat_ns.errors import PointSplatError


@functools.cache
def gsplat_works() -> bool:
    """Whether gsplat's CUDA kernels are there. The first call may compile them, as Splatfacto's first step does."""
    if not torch.cuda.is_available():
        return False
    try:
        from gsplat.cuda._backend import _C
    except Exception:  # a failed compilation raises errors of many types
        return False
    return _C is not None


def use_gsplat(backend: str, device: torch.device) -> bool:
    """Whether ``backend`` ("gsplat" or "auto"; others are a ValueError) means gsplat for tensors on ``device``. Raises
    PointSplatError if gsplat is asked for and cannot be used."""
    if backend not in ("gsplat", "auto"):
        raise ValueError(f"backend is {backend!r}; expected torch, gsplat or auto")
    usable = device.type == "cuda" and gsplat_works()
    if backend == "gsplat" and not usable:
        raise PointSplatError(
            f"backend gsplat: the Gaussians are on {device.type} and gsplat's CUDA kernels are "
            f"{'there' if gsplat_works() else 'not there'}; expected both on CUDA; use auto or torch"
        )
    return usable
