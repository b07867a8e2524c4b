"""Functions of the C++ files of this package: built when the package is installed, and called on
several threads.

A module that calls a kernel declares it: the structs that it takes as classes (:class:`Struct`),
the function with the types of its arguments (:class:`Function`). Tests compare the declarations
with those of the C++ files by a compiler.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any, ClassVar

import torch

from pointsplat_ns.system.native import IS_X86, library_path
from pointsplat_ns.system.threads import most_threads, pool

logger = logging.getLogger("pointsplat_ns")


class Pointer:
    """Type of a pointer, which takes contiguous tensors on the CPU, of one dtype or of any,
    addresses and None."""

    def __init__(self, dtype: torch.dtype | None):
        self.dtype = dtype

    def address(self, value: Any) -> int | None:
        """The address of a tensor; None and addresses as they are. Raises TypeError if the tensor
        has another dtype or device, or is not contiguous."""
        if not isinstance(value, torch.Tensor):
            return value
        if self.dtype not in (None, value.dtype) or not value.is_cpu or not value.is_contiguous():
            raise TypeError(
                f"tensor of {value.dtype} on {value.device} with strides {value.stride()}; "
                f"expected {self.dtype} on the CPU, contiguous"
            )
        return value.data_ptr()

    def from_param(self, value: Any) -> Any:
        """What ctypes passes for an argument."""
        if value is None or isinstance(value, (int, torch.Tensor)):
            return ctypes.c_void_p(self.address(value))
        return value


FLOAT_POINTER = Pointer(torch.float32)
DOUBLE_POINTER = Pointer(torch.float64)
INT32_POINTER = Pointer(torch.int32)
INT64_POINTER = Pointer(torch.int64)
ANY_POINTER = Pointer(None)
"""Of structs, in a tensor of bytes."""


def c_fields(members: dict[str, Any]) -> list[tuple[str, Any]]:
    """The ``_fields_`` of a struct with these members."""
    return [
        (name, ctypes.c_void_p if isinstance(kind, Pointer) else kind)
        for name, kind in members.items()
    ]


class Struct(ctypes.Structure):
    """A struct of a C++ file. A subclass lists its members in ``members``, in the order of the
    file, and has ``_fields_ = c_fields(members)``; arrays are flat. :meth:`fill` sets pointers to
    what :class:`Pointer` takes, and keeps tensors alive."""

    members: ClassVar[dict[str, Any]] = {}
    """Types of the members by name: a type of ctypes, another struct, or a :class:`Pointer`."""

    def __init__(self, **values: Any):
        self.kept: dict[str, Any] = {}
        self.fill(**values)

    def fill(self, **values: Any) -> None:
        """Set fields. Raises AttributeError if there is no such field, and TypeError if a value
        does not fit its type."""
        unknown = values.keys() - self.members.keys()
        if unknown:
            raise AttributeError(f"{type(self).__name__} has no member {sorted(unknown)[0]}")
        self.kept.update(values)
        for name, value in values.items():
            kind = self.members[name]
            setattr(self, name, kind.address(value) if isinstance(kind, Pointer) else value)

    @classmethod
    def from_param(cls, value: Any) -> Any:
        """What ctypes passes for an argument: the address of a struct of this class. Raises
        TypeError for anything else."""
        if not isinstance(value, cls):
            raise TypeError(f"{type(value).__name__}; expected {cls.__name__}")
        return ctypes.byref(value)


FUNCTIONS: dict[str, Function] = {}
"""All that are declared, by name."""


class Function:
    """A function of a C++ file, found in the library when it is first called.

    Args:
        name: its name in the file.
        arguments: types of its arguments: types of ctypes, :class:`Pointer`, and classes of
            structs, which it takes by address.
        result: type of its result; None if it has none.
    """

    def __init__(self, name: str, *arguments: Any, result: Any = None):
        self.name = name
        self.arguments = arguments
        self.result = result
        FUNCTIONS[name] = self

    @functools.cached_property
    def _loaded(self) -> Callable[..., Any]:
        function = getattr(KERNELS.library, self.name)
        function.restype = self.result
        function.argtypes = self.arguments
        return function

    def __call__(self, *arguments: Any) -> Any:
        """Call the function. Raises TypeError if the number or a type of the arguments is wrong,
        and OSError if the library was not built."""
        if len(arguments) != len(self.arguments):  # ctypes lets more pass
            raise TypeError(
                f"{self.name}: {len(arguments)} arguments; expected {len(self.arguments)}"
            )
        return self._loaded(*arguments)


SEVERAL = 4000
"""Gaussians, or pairs of Gaussian and tile, from which on several threads are faster than one."""


class Kernels:
    """Functions of the C++ files that are faster than torch. All are used or none, because results
    would else be rounded by the one here and by torch there.

    Args:
        path: their library, which an installation builds.
    """

    def __init__(self, path: Path):
        self._path = path

    @functools.cached_property
    def library(self) -> ctypes.CDLL:
        """The functions. Raises OSError if they were not built."""
        return ctypes.CDLL(str(self._path))

    @functools.cached_property
    def why_missing(self) -> str:
        """The reason why this machine cannot use them; empty if it can."""
        if IS_X86 and not torch.backends.cpu.get_cpu_capability().startswith("AVX"):  # AVX2 or more
            why = "this processor, or ATEN_CPU_CAPABILITY, has no AVX2"
        elif not self._path.is_file():
            others = any(self._path.parent.glob("kernels.*.so"))
            found = "they were built from other sources" if others else "they were not built"
            why = (
                f"{found}; where there is a C++ compiler, installing builds them (in a clone: pip "
                "install -e .)"
            )
        else:
            try:
                ctypes.CDLL(str(self._path))
                return ""
            except OSError as error:
                why = " ".join(str(error).split())
        logger.warning(
            "compiled kernels are not used, torch computes all, slower, rounded otherwise: %s", why
        )
        return why

    def usable(self, wanted: bool | None) -> bool:
        """Whether to use them: not if ``wanted`` is False. True warns where there are none."""
        if wanted is False:
            return False
        why = self.why_missing
        if why and wanted:
            warnings.warn(
                f"torch computes what kernels were asked for: {why}", stacklevel=1
            )  # one text is shown once
        return not why

    def usable_for(self, wanted: bool | None, *tensors: torch.Tensor) -> bool:
        """Whether to use them for these tensors: float32, on a CPU; ``wanted`` as for
        :meth:`usable`."""
        suited = all(
            tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors
        )
        return suited and self.usable(wanted)


KERNELS = Kernels(library_path())


def on_threads(worth_it: bool, function: Callable[..., object], *arguments: object) -> None:
    """Call a function of a C++ file in :func:`~pointsplat_ns.system.threads.most_threads` threads,
    or in one if more are not worth it.

    The last parameter of the function points to the number of pieces of work that threads have
    taken. ctypes lets go of Python during the call.
    """
    taken = ctypes.c_int64(0)
    call = functools.partial(function, *arguments, ctypes.byref(taken))
    threads = most_threads() if worth_it else 1
    others: list[Future[object]] = []
    try:
        try:
            for _ in range(threads - 1):
                others.append(pool("kernel", os.cpu_count() or 1).submit(call))
        except RuntimeError as error:  # no more threads are started: this one does the rest
            ending = "shutdown" in str(error)  # else the system has a limit
            if ending and threading.current_thread() is not threading.main_thread():
                raise SystemExit from None  # ends one of a viewer, for which nobody waits
        call()
    finally:
        wait(others)  # they use the memory of the arguments, also where Ctrl-C ended the call here
    for other in others:
        other.result()
