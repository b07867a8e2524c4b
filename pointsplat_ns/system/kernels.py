"""Calls the package's C++ functions, which are compiled at installation, on several threads.

A module that calls a kernel declares its structs (:class:`Struct`) and its function with argument
types (:class:`Function`). Tests compare the declarations with the C++ files, by a compiler.
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
    """Pointer type. Accepts contiguous CPU tensors, of one dtype or of any, addresses and None."""

    def __init__(self, dtype: torch.dtype | None):
        self.dtype = dtype

    def address(self, value: Any) -> int | None:
        """Address of a tensor; None and addresses are returned unchanged. Raises TypeError if the
        tensor has another dtype or device, or is not contiguous."""
        if not isinstance(value, torch.Tensor):
            return value
        if self.dtype not in (None, value.dtype) or not value.is_cpu or not value.is_contiguous():
            raise TypeError(
                f"tensor of {value.dtype} on {value.device} with strides {value.stride()}; "
                f"expected {self.dtype} on the CPU, contiguous"
            )
        return value.data_ptr()

    def from_param(self, value: Any) -> Any:
        """Value that ctypes passes for an argument."""
        if value is None or isinstance(value, (int, torch.Tensor)):
            return ctypes.c_void_p(self.address(value))
        return value


FLOAT_POINTER = Pointer(torch.float32)
DOUBLE_POINTER = Pointer(torch.float64)
INT32_POINTER = Pointer(torch.int32)
INT64_POINTER = Pointer(torch.int64)
ANY_POINTER = Pointer(None)
"""Points to structs in a tensor of bytes."""


def c_fields(members: dict[str, Any]) -> list[tuple[str, Any]]:
    """The ``_fields_`` of a struct with these members."""
    return [
        (name, ctypes.c_void_p if isinstance(kind, Pointer) else kind)
        for name, kind in members.items()
    ]


class Struct(ctypes.Structure):
    """A struct of a C++ file. A subclass lists its members in ``members``, in the order of the
    file, and has ``_fields_ = c_fields(members)``; arrays are flat. :meth:`fill` sets pointers to
    the values that :class:`Pointer` accepts, and keeps references to tensors."""

    members: ClassVar[dict[str, Any]] = {}
    """Types of the members by name: a type of ctypes, another struct, or a :class:`Pointer`."""

    def __init__(self, **values: Any):
        self.references: dict[str, Any] = {}
        self.fill(**values)

    def fill(self, **values: Any) -> None:
        """Set fields. Raises AttributeError for unknown fields, and TypeError for wrong types."""
        unknown = values.keys() - self.members.keys()
        if unknown:
            raise AttributeError(f"{type(self).__name__} has no member {sorted(unknown)[0]}")
        self.references.update(values)
        for name, value in values.items():
            kind = self.members[name]
            setattr(self, name, kind.address(value) if isinstance(kind, Pointer) else value)

    @classmethod
    def from_param(cls, value: Any) -> Any:
        """Value that ctypes passes for an argument: the address of a struct of this class. Raises
        TypeError for any other type."""
        if not isinstance(value, cls):
            raise TypeError(f"{type(value).__name__}; expected {cls.__name__}")
        return ctypes.byref(value)


FUNCTIONS: dict[str, Function] = {}
"""All declared functions by name."""


class Function:
    """A function of a C++ file, looked up in the library at its first call.

    Args:
        name: name in the file.
        arguments: argument types: ctypes types, :class:`Pointer`, and subclasses of
            :class:`Struct`, which are passed by address.
        result: result type; None if it returns nothing.
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


LANES = 8
"""Numbers that the kernels compute at a time: ``LANES`` of ``lanes.h``."""

SEVERAL = 4000
"""Gaussians, or pairs of Gaussian and tile, above which several threads are faster than one."""


class Kernels:
    """The compiled functions. Either all or none are used, because the kernels and torch round
    differently.

    Args:
        path: the library, built at installation.
    """

    def __init__(self, path: Path):
        self._path = path

    @functools.cached_property
    def library(self) -> ctypes.CDLL:
        """The loaded library. Raises OSError if it was not built."""
        return ctypes.CDLL(str(self._path))

    @functools.cached_property
    def why_missing(self) -> str:
        """Why this machine cannot use the kernels; empty if it can."""
        if IS_X86 and not torch.backends.cpu.get_cpu_capability().startswith("AVX"):  # AVX2 or more
            why = "AVX2 is missing in this processor, or disabled by ATEN_CPU_CAPABILITY"
        elif not self._path.is_file():
            others = any(self._path.parent.glob("kernels.*.so"))
            found = "built from other sources" if others else "not built"
            why = f"{found}; {self._how_to_build}"
        else:
            try:
                ctypes.CDLL(str(self._path))
                return ""
            except OSError as error:
                why = " ".join(str(error).split())
        logger.warning(
            "no compiled kernels, using slower PyTorch code; results differ in the last digits: %s",
            why,
        )
        return why

    @property
    def _how_to_build(self) -> str:
        """What to run. A clone in the current folder hides an installed package and its kernels."""
        clone = self._path.parents[2] if len(self._path.parents) > 2 else self._path.parent
        if (clone / "setup.py").is_file():
            return (
                f"with a C++ compiler, in {clone}: python setup.py build_ext --inplace (this clone "
                "is used, not an installed package)"
            )
        return "installing builds them if there is a C++ compiler (in a clone: pip install -e .)"

    def usable(self, wanted: bool | None) -> bool:
        """Whether to use the kernels. False never does; True warns if they are missing."""
        if wanted is False:
            return False
        why = self.why_missing
        if why and wanted:
            # Python shows each text once
            warnings.warn(
                f"compiled kernels are missing, using PyTorch instead: {why}", stacklevel=1
            )
        return not why

    def usable_for(self, wanted: bool | None, *tensors: torch.Tensor) -> bool:
        """Whether to use the kernels for these tensors: float32, on a CPU; see :meth:`usable`."""
        suited = all(
            tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors
        )
        return suited and self.usable(wanted)


KERNELS = Kernels(library_path())


def on_threads(worth_it: bool, function: Callable[..., object], *arguments: object) -> None:
    """Call a C++ function on :func:`~pointsplat_ns.system.threads.most_threads` threads, or on one
    if more are not ``worth_it``.

    The last parameter of the function points to a counter of the work items taken by threads.
    ctypes releases the GIL during the call.
    """
    taken = ctypes.c_int64(0)
    call = functools.partial(function, *arguments, ctypes.byref(taken))
    threads = most_threads() if worth_it else 1
    others: list[Future[object]] = []
    try:
        try:
            for _ in range(threads - 1):
                others.append(pool("kernel", os.cpu_count() or 1).submit(call))
        except RuntimeError as error:  # cannot start more threads: this one does the rest
            ending = "shutdown" in str(error)  # else the system's limit is reached
            if ending and threading.current_thread() is not threading.main_thread():
                raise SystemExit from None  # ends a viewer's thread, for which nobody waits
        call()
    finally:
        wait(others)  # they use the arguments' memory, even if Ctrl-C ended the call here
    for other in others:
        other.result()
