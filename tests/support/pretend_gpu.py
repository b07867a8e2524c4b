"""A GPU that every machine has, for want of a real one: tensors that say they are elsewhere, and
are computed on the CPU.

While :func:`pretend_gpu` is open, torch's device "meta" holds numbers. Operations that mix its
tensors with those of the CPU fail as they do on a GPU. All operations on it are listed with their
thread.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

GPU = torch.device("meta")
"""The device. Its name is one that torch knows, needs no library for, and whose backward pass runs
where it is called."""


class Recorded:
    """Names of operations on the device since it is there, each with the thread that called it."""

    def __init__(self) -> None:
        self.here = threading.get_ident()
        self.operations: list[tuple[str, int]] = []

    def from_other_threads(self) -> set[str]:
        return {name for name, thread in self.operations if thread != self.here}

    def linear_algebra(self) -> set[str]:
        """Those that need the library of linear algebra that torch loads when one is first
        called."""
        return {
            name
            for name, _ in self.operations
            if "linalg" in name and not re.search("cross|norm", name)
        }


recorded: Recorded | None = None


class _There(torch.Tensor):
    """A tensor of the device, with its numbers in ``numbers``, a tensor on the CPU."""

    numbers: torch.Tensor

    @staticmethod
    def __new__(cls, numbers: torch.Tensor) -> _There:
        there = torch.Tensor._make_wrapper_subclass(
            cls,
            numbers.shape,
            strides=numbers.stride(),
            storage_offset=numbers.storage_offset(),
            dtype=numbers.dtype,
            device=GPU,
        )
        there.numbers = numbers
        return there

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _computed(function, args, kwargs or {})

    __torch_function__ = torch._C._disabled_torch_function_impl

    def tolist(self) -> Any:  # which torch does not give for classes of others
        return self.detach().cpu().tolist()


def _computed(function: Any, args: tuple, kwargs: dict) -> Any:
    given = [value for value in tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)]
    there = any(isinstance(value, _There) for value in given)
    device = kwargs.get("device")
    to = there if device is None else torch.device(device) == GPU
    name = str(function)
    if there and name not in ("aten._to_copy.default", "aten.copy_.default"):
        # a number may stay on the CPU, and so may indices into a tensor of it
        mixed = [value for value in given if not isinstance(value, _There) and value.dim()]
        if mixed and not name.startswith("aten.index"):
            raise RuntimeError(f"{name}: tensors are on the CPU and on {GPU}; expected one device")
    if recorded is not None and (there or to):
        recorded.operations.append((name, threading.get_ident()))
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    args, kwargs = tree_map(
        lambda value: value.numbers if isinstance(value, _There) else value, (args, kwargs)
    )
    result = function(*args, **kwargs)
    mutated = [value for value in given if isinstance(value, _There) and value.numbers is result]
    if mutated:
        return mutated[0]
    return tree_map(
        lambda value: _There(value) if to and isinstance(value, torch.Tensor) else value, result
    )


class _Here(
    TorchDispatchMode
):  # catches what makes tensors of the device from nothing, or from those of the CPU
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _computed(function, args, kwargs or {})


def _made_here(function: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    """A function that makes a tensor of numbers, which it copies to the device: torch writes none
    to its own "meta"."""

    def made(*args: Any, device: Any = None, **options: Any) -> torch.Tensor:
        if device is None or torch.device(device) != GPU:
            return function(*args, device=device, **options)
        return function(*args, device="cpu", **options).to(GPU)

    return made


def _new_tensor(like: torch.Tensor, data: Any, **options: Any) -> torch.Tensor:
    return torch.tensor(data, **{"dtype": like.dtype, "device": like.device, **options})


class _Autocast(torch.autocast):  # torch knows no precision of its own "meta"
    def __init__(self, device_type: str, *arguments: Any, **options: Any):
        super().__init__("cpu" if device_type == GPU.type else device_type, *arguments, **options)


@contextmanager
def pretend_gpu() -> Iterator[Recorded]:
    """Let tensors be moved to :data:`GPU` while the context is open, and give the record of what is
    done there."""
    global recorded
    recorded = Recorded()
    patched = {name: _made_here(getattr(torch, name)) for name in ("tensor", "as_tensor")}
    patched["autocast"] = _Autocast
    try:
        with (
            _Here(),
            mock.patch.multiple(torch, **patched),
            mock.patch.object(torch.Tensor, "new_tensor", _new_tensor),
        ):
            yield recorded
    finally:
        recorded = None
