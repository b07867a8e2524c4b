"""Functions of a C++ file of this package: built and tried when first used, and called on several threads."""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from pointsplat_ns.system.declarations import Struct, functions_of, structs_of
from pointsplat_ns.system.native_code import NativeCodeError, load_native

SEVERAL = 4000
"""Gaussians, or pairs of Gaussian and tile, from which on several threads are faster than one."""


class Kernels:
    """Functions of a C++ file that are faster than torch.

    Args:
        what: name of the feature, for warnings.
        source: the file. What it declares is what Python calls, see :mod:`~pointsplat_ns.system.declarations`.
        agree: whether the functions do what torch does, on a small input, so that no miscompilation passes; it may call
            them.
    """

    def __init__(self, what: str, source: Path, agree: Callable[[], bool]):
        self.what, self.source, self.agree = what, source, agree

    @functools.cached_property
    def structs(self) -> dict[str, type[Struct]]:
        """The structs that the functions take, by name."""
        return structs_of(self.source.read_text("utf-8"))

    @functools.cached_property
    def library(self) -> ctypes.CDLL:
        """The functions, built if need be.

        Raises:
            NativeCodeError: if this machine cannot build them.
        """
        library = load_native(self.source)
        for name, (result, parameters) in functions_of(self.source.read_text("utf-8"), self.structs).items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, parameters
        return library

    @functools.cached_property
    def why_missing(self) -> str:
        """The reason why this machine cannot use them; empty if it can. They are built if need be, and tried."""
        try:
            _ = self.library
        except NativeCodeError as error:
            return str(error)
        with torch.inference_mode(False):
            agree = self.agree()
        return "" if agree else f"what the compiler made of {self.source.name} does not do what torch does"

    def usable(self, wanted: bool | None) -> bool:
        """Whether to use them.

        Args:
            wanted: False where they are not wanted; None where a machine without a compiler is no reason for a warning.
        """
        if wanted is False:
            return False
        if self.why_missing and wanted:
            # stacklevel 1: warnings of several kernels with one text are shown once
            text = f"{self.what} could not be compiled and stays with torch: {self.why_missing}"
            warnings.warn(text, stacklevel=1)
        return not self.why_missing

    def usable_for(self, wanted: bool | None, *tensors: torch.Tensor) -> bool:
        """Whether to use them for these tensors: float32, on a CPU; ``wanted`` as for :meth:`usable`."""
        suited = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors)
        return suited and self.usable(wanted)


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of a process: those of one that forked are not the other's."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="pointsplat-kernel")


def on_threads(worth_it: bool, function: Callable[..., object], *arguments: object, threads: int | None = None) -> None:
    """Call a function of a C++ file in ``threads`` threads, by default as many as torch uses, or in one if more are not
    worth it.

    The last parameter of the function points to the number of pieces of work that threads have taken. ctypes lets go of
    Python during the call.
    """
    taken = ctypes.c_int64(0)
    call = functools.partial(function, *arguments, ctypes.byref(taken))
    threads = (threads or torch.get_num_threads()) if worth_it else 1
    others = [_pool(os.getpid()).submit(call) for _ in range(threads - 1)]
    call()
    for other in others:
        other.result()


def agreement(ours: Sequence[torch.Tensor], torchs: Sequence[torch.Tensor], off: float, share: float) -> bool:
    """Whether tensors agree: in each, less than a share of the numbers is further off than so much of the largest."""
    within = [(a - b).abs() <= off * b.abs().amax() for a, b in zip(ours, torchs, strict=True)]  # NaN is not
    return all(bool((~near).float().mean() < share) for near in within)
