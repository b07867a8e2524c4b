"""Structs and functions that a C++ file shares with Python, read from the file itself: nothing is declared twice.

A file shares what stands between ``extern "C" {`` and ``}  // extern "C"``: functions, and plain structs of numbers,
arrays, pointers and earlier structs.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Iterator
from typing import Any, ClassVar

import torch

_NUMBERS = {
    "int": (ctypes.c_int, None),
    "int32_t": (ctypes.c_int32, torch.int32),
    "int64_t": (ctypes.c_int64, torch.int64),
    "float": (ctypes.c_float, torch.float32),
    "double": (ctypes.c_double, torch.float64),
}


class Pointer:
    """Type of a pointer, which takes contiguous tensors on the CPU, structs, addresses and None.

    Args:
        dtype: of the tensors; None takes any.
    """

    def __init__(self, dtype: torch.dtype | None):
        self.dtype = dtype

    def address(self, value: Any) -> int | None:
        """The address of a tensor; None and addresses as they are.

        Raises:
            TypeError: if the tensor has another dtype or device, or is not contiguous.
        """
        if value is None or not isinstance(value, torch.Tensor):
            return value
        fits = self.dtype is None or value.dtype is self.dtype
        if not (fits and value.is_cpu and value.is_contiguous()):
            raise TypeError(
                f"tensor of {value.dtype} on {value.device} with strides {value.stride()}; expected {self.dtype} on "
                "the CPU, contiguous"
            )
        return value.data_ptr()

    def from_param(self, value: Any) -> Any:
        """What ctypes passes for an argument."""
        if value is None or isinstance(value, (int, torch.Tensor)):
            return ctypes.c_void_p(self.address(value))
        return ctypes.byref(value) if isinstance(value, ctypes.Structure) else value


class Struct(ctypes.Structure):
    """A struct of a C++ file. :meth:`fill` sets pointers to what :class:`Pointer` takes, and keeps tensors alive."""

    __slots__ = ("kept",)
    members: ClassVar[dict[str, Pointer | None]] = {}
    """The type of each field that is a pointer, None for others."""

    def __init__(self, **values: Any):
        self.kept: dict[str, Any] = {}
        self.fill(**values)

    def fill(self, **values: Any) -> None:
        """Set fields.

        Raises:
            AttributeError: if the struct has no such field.
            TypeError: if a value does not fit its type.
        """
        self.kept.update(values)
        members = self.members
        for name, value in values.items():
            pointer = members.get(name)
            setattr(self, name, value if pointer is None else pointer.address(value))


def structs_of(text: str) -> dict[str, type[Struct]]:
    """The structs that a C++ file shares, by name.

    Args:
        text: of the file.

    Raises:
        ValueError: if a field is of an unknown type.
    """
    found: dict[str, type[Struct]] = {}
    for name, body in re.findall(r"^struct (\w+) \{\n(.*?)^\};", _shared(text), re.M | re.S):
        members, fields = {}, []
        for statement in filter(None, map(str.strip, body.split(";"))):
            for field, kind in _declared(statement, found):
                members[field] = kind if isinstance(kind, Pointer) else None
                fields.append((field, ctypes.c_void_p if isinstance(kind, Pointer) else kind))
        found[name] = type(name, (Struct,), {"__slots__": (), "members": members, "_fields_": fields})
    return found


def functions_of(text: str, structs: dict[str, type[Struct]]) -> dict[str, tuple[Any, list[Any]]]:
    """Type of the result and types of the arguments of the functions that a C++ file shares, by name.

    Args:
        text: of the file.
        structs: those that it shares.

    Raises:
        ValueError: if a type is unknown.
    """
    found = {}
    for result, name, parameters in re.findall(r"^(\w+) (\w+)\(([^)]*)\) \{", _shared(text), re.M):
        listed = [_declared(parameter, structs) for parameter in filter(None, parameters.split(","))]
        found[name] = None if result == "void" else _NUMBERS[result][0], [kind for ((_, kind),) in map(list, listed)]
    return found


def _shared(text: str) -> str:
    """What a C++ file shares, without comments."""
    return "\n".join(
        re.sub(r"//.*", "", part) for part in re.findall(r'^extern "C" \{\n(.*?)^\}  // extern "C"', text, re.M | re.S)
    )


def _declared(statement: str, structs: dict[str, type[Struct]]) -> Iterator[tuple[str, Any]]:
    """Names and types that a statement such as ``const float *a, b[3]`` declares; arrays are flat."""
    matched = re.fullmatch(r"(?:const )?(\w+)\b(.*)", " ".join(statement.split()))
    for declarator in matched[2].split(",") if matched else [""]:
        parts = re.fullmatch(r" ?(\*?) ?(\w+)((?:\[\d+\])*)", declarator)
        base = matched and ((structs.get(matched[1]), None) if matched[1] in structs else _NUMBERS.get(matched[1]))
        if not parts or not base:
            raise ValueError(f"{statement!r}: not a declaration of numbers, arrays, pointers or structs")
        kind: Any = Pointer(base[1]) if parts[1] else base[0]
        if parts[3]:  # of several dimensions: all numbers in a row
            kind = kind * math.prod(map(int, re.findall(r"\d+", parts[3])))
        yield parts[2], kind
