"""Keeps autocast away from the rasterizer."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def full_precision(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Run a function without autocast on the device of its first tensor.

    In bfloat16, to which autocast rounds matrix products, a position of 100 pixels is held to half a pixel.
    """

    @functools.wraps(function)
    def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        kind = next((value.device.type for value in (*args, *kwargs.values()) if isinstance(value, Tensor)), "")
        if kind not in ("cpu", "cuda"):
            return function(*args, **kwargs)
        with torch.autocast(kind, enabled=False):
            return function(*args, **kwargs)

    return run
