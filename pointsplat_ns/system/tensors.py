"""Independence of torch's global settings: tensors get an explicit dtype and device, functions that
need gradients leave the caller's inference mode, and the rasterizer leaves autocast."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

from pointsplat_ns.system.threads import one_thread_each

FLOATS: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
DOUBLES: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
INDICES: dict[str, Any] = {"dtype": torch.int64, "device": "cpu"}
FLAGS: dict[str, Any] = {"dtype": torch.bool, "device": "cpu"}


def numbers(count: int, device: torch.device) -> torch.Tensor:
    """0, 1, ... (count,) int64 on a device."""
    return torch.arange(count, dtype=torch.int64, device=device)


def add_rows(total: torch.Tensor, index: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Add values (n, *) to the rows ``index`` (n,) of a total (N, *), and return it. The order of
    summation is fixed on each device, unlike that of ``index_add_`` on a GPU."""
    if total.device.type == "cpu":
        return total.index_add_(0, index, values)
    return total.index_put_((index,), values, accumulate=True)


Function = TypeVar("Function", bound=Callable[..., Any])


def of_network() -> dict[str, Any]:
    """dtype and device of a network's parameters: float32, on the device context of the network's
    constructor, which ``torch.get_default_device`` does not report in torch 2.6."""
    return {"dtype": torch.float32, "device": None}


def normal_mode(function: Function) -> Function:
    """Run the function with :func:`~pointsplat_ns.system.threads.one_thread_each` and outside of
    inference mode. Scenes and views that were created in inference mode are copied, because torch
    computes no gradients for such tensors."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        with torch.inference_mode(False), one_thread_each():
            return function(
                *map(_copied, args), **{name: _copied(value) for name, value in kwargs.items()}
            )

    return cast(Function, run)


def full_precision(function: Function) -> Function:
    """Run the function without autocast on the device of its first tensor: in bfloat16, to which
    autocast rounds matrix products, a position of 100 pixels has a precision of half a pixel."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        kind = next(
            (
                value.device.type
                for value in (*args, *kwargs.values())
                if isinstance(value, torch.Tensor)
            ),
            "",
        )
        if kind not in ("cpu", "cuda"):
            return function(*args, **kwargs)
        with torch.autocast(kind, enabled=False):
            return function(*args, **kwargs)

    return cast(Function, run)


def _copied(value: Any) -> Any:
    """A copy of an inference-mode tensor, or of a dataclass with such tensors; anything else
    unchanged."""
    if isinstance(value, torch.Tensor):
        return value.clone() if value.is_inference() else value
    fields = (
        dataclasses.fields(value)
        if dataclasses.is_dataclass(value) and not isinstance(value, type)
        else ()
    )
    parts = {field.name: getattr(value, field.name) for field in fields if field.init}
    copies = {name: _copied(part) for name, part in parts.items()}
    changes = {name: copy for name, copy in copies.items() if copy is not parts[name]}
    return dataclasses.replace(value, **changes) if changes else value
