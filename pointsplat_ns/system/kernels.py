"""Calls the package's C++ functions, which are compiled at installation, on several threads.

Structs and functions are parsed from the C++ files and their headers, so that they are declared
once. A file exports the code between ``extern "C" {`` and ``}  // extern "C"``: functions, and
plain structs of numbers, arrays, pointers and earlier structs.
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
    """Pointer type. Accepts contiguous CPU tensors, of one dtype or of any, structs, addresses and
    None."""

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
        return ctypes.byref(value) if isinstance(value, Struct) else value


class Struct(ctypes.Structure):
    """A struct of a C++ file. :meth:`fill` sets pointers to the values that :class:`Pointer`
    accepts, and keeps references to tensors."""

    __slots__ = ("kept",)
    pointers: ClassVar[dict[str, Pointer]] = {}

    def __init__(self, **values: Any):
        self.kept: dict[str, Any] = {}
        self.fill(**values)

    def fill(self, **values: Any) -> None:
        """Set fields. Raises AttributeError for an unknown field, and TypeError for a value of the
        wrong type."""
        self.kept.update(values)
        pointers = self.pointers
        for name, value in values.items():
            setattr(self, name, pointers[name].address(value) if name in pointers else value)


def structs_of(text: str) -> dict[str, type[Struct]]:
    """The structs that the text of a C++ file exports, by name. Raises ValueError if a field has an
    unknown type."""
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
    """Result type and argument types of the functions that the text of a C++ file exports, by name,
    given its structs. Raises ValueError if a type is unknown."""
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
    """The exported part of a C++ file, without comments."""
    return re.sub(
        r"//.*",
        "",
        "\n".join(re.findall(r'^extern "C" \{\n(.*?)^\}  // extern "C"', text, re.M | re.S)),
    )


def _declared(statement: str, structs: dict[str, type[Struct]]) -> list[tuple[str, Any]]:
    """Names and types in a declaration such as ``const float *a, b[3]``; arrays are flattened."""
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
    def _text(self) -> str:
        return "".join(path.read_text("utf-8") for path in (*cpp_files("*.h"), *cpp_files()))

    @functools.cached_property
    def structs(self) -> dict[str, type[Struct]]:
        """The structs of the functions' parameters, by name."""
        return structs_of(self._text)

    @functools.cached_property
    def library(self) -> ctypes.CDLL:
        """The loaded library. Raises OSError if it was not built."""
        library = ctypes.CDLL(str(self._path))
        for name, (result, parameters) in functions_of(self._text, self.structs).items():
            function = getattr(library, name)
            function.restype = result
            function.argtypes = parameters
        return library

    @functools.cached_property
    def why_missing(self) -> str:
        """Why this machine cannot use the kernels; empty if it can."""
        if IS_X86 and not torch.backends.cpu.get_cpu_capability().startswith("AVX"):  # AVX2 or more
            why = "AVX2 is missing in this processor, or disabled by ATEN_CPU_CAPABILITY"
        elif not self._path.is_file():
            others = any(self._path.parent.glob("kernels.*.so"))
            found = "built from other sources" if others else "not built"
            why = (
                f"{found}; installing builds them if there is a C++ compiler (in a clone: pip "
                "install -e .)"
            )
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
        """Whether to use the kernels for these tensors: float32, on a CPU; ``wanted`` as for
        :meth:`usable`."""
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
