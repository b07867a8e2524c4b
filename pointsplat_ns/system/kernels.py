"""Functions of the C++ files of this package: built when the package is installed, and called on
several threads.

Structs and functions are read from the files and their headers, so that nothing is declared twice.
Files share what is between ``extern "C" {`` and ``}  // extern "C"``: functions, and plain structs
of numbers, arrays, pointers and earlier structs.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import math
import os
import re
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any, ClassVar

import torch

from pointsplat_ns.system.native import IS_X86, cpp_files, library_path
from pointsplat_ns.system.threads import most_threads, pool

logger = logging.getLogger("pointsplat_ns")

_NUMBERS = {
    "int": (ctypes.c_int, None),
    "int32_t": (ctypes.c_int32, torch.int32),
    "int64_t": (ctypes.c_int64, torch.int64),
    "float": (ctypes.c_float, torch.float32),
    "double": (ctypes.c_double, torch.float64),
}


class Pointer:
    """Type of a pointer, which takes contiguous tensors on the CPU, of one dtype or of any,
    structs, addresses and None."""

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
        return ctypes.byref(value) if isinstance(value, Struct) else value


class Struct(ctypes.Structure):
    """A struct of a C++ file. :meth:`fill` sets pointers to what :class:`Pointer` takes, and keeps
    tensors alive."""

    __slots__ = ("kept",)
    pointers: ClassVar[dict[str, Pointer]] = {}

    def __init__(self, **values: Any):
        self.kept: dict[str, Any] = {}
        self.fill(**values)

    def fill(self, **values: Any) -> None:
        """Set fields. Raises AttributeError if there is no such field, and TypeError if a value
        does not fit its type."""
        self.kept.update(values)
        pointers = self.pointers
        for name, value in values.items():
            setattr(self, name, pointers[name].address(value) if name in pointers else value)


def structs_of(text: str) -> dict[str, type[Struct]]:
    """The structs that the text of a C++ file shares, by name. Raises ValueError if a field is of
    an unknown type."""
    found: dict[str, type[Struct]] = {}
    for name, body in re.findall(r"^struct (\w+) \{\n(.*?)^\};", _shared(text), re.M | re.S):
        declared = [
            each
            for statement in body.split(";")
            if statement.strip()
            for each in _declared(statement, found)
        ]
        pointers = {field: kind for field, kind in declared if isinstance(kind, Pointer)}
        fields = [
            (field, ctypes.c_void_p if field in pointers else kind) for field, kind in declared
        ]
        found[name] = type(
            name, (Struct,), {"__slots__": (), "pointers": pointers, "_fields_": fields}
        )
    return found


def functions_of(text: str, structs: dict[str, type[Struct]]) -> dict[str, tuple[Any, list[Any]]]:
    """Type of the result and types of the arguments of the functions that the text of a C++ file
    shares, by name, given its structs. Raises ValueError if a type is unknown."""
    found = {}
    for result, name, parameters in re.findall(r"^(\w+) (\w+)\(([^)]*)\) \{", _shared(text), re.M):
        kinds = [
            kind
            for each in filter(None, parameters.split(","))
            for _, kind in _declared(each, structs)
        ]
        found[name] = None if result == "void" else _NUMBERS[result][0], kinds
    return found


def _shared(text: str) -> str:
    """What a C++ file shares, without comments."""
    return re.sub(
        r"//.*",
        "",
        "\n".join(re.findall(r'^extern "C" \{\n(.*?)^\}  // extern "C"', text, re.M | re.S)),
    )


def _declared(statement: str, structs: dict[str, type[Struct]]) -> list[tuple[str, Any]]:
    """Names and types that a statement such as ``const float *a, b[3]`` declares; arrays are
    flat."""
    found: list[tuple[str, Any]] = []
    base, declarators = re.sub(r"^\s*(const )?", "", statement).split(None, 1)
    if base.endswith("*"):
        base = base[:-1]
        declarators = f"*{declarators}"
    number: Any
    number, dtype = (structs[base], None) if base in structs else _NUMBERS.get(base, (None, None))
    for declarator in declarators.split(","):
        parts = re.fullmatch(r"\s*(\*?)\s*(\w+)((?:\[\d+\])*)\s*", declarator)
        if not parts or number is None:
            raise ValueError(
                f"{statement!r}: not a declaration of numbers, arrays, pointers or structs"
            )
        sizes = [int(size) for size in re.findall(r"\d+", parts[3])]
        found.append(
            (
                parts[2],
                Pointer(dtype) if parts[1] else number * math.prod(sizes) if sizes else number,
            )
        )
    return found


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
    def _text(self) -> str:
        return "".join(path.read_text("utf-8") for path in (*cpp_files("*.h"), *cpp_files()))

    @functools.cached_property
    def structs(self) -> dict[str, type[Struct]]:
        """The structs that the functions take, by name."""
        return structs_of(self._text)

    @functools.cached_property
    def library(self) -> ctypes.CDLL:
        """The functions. Raises OSError if they were not built."""
        library = ctypes.CDLL(str(self._path))
        for name, (result, parameters) in functions_of(self._text, self.structs).items():
            function = getattr(library, name)
            function.restype = result
            function.argtypes = parameters
        return library

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
