"""The C++ files of this package, and the library that installing the package makes of them.

``setup.py`` runs this file by itself, so it imports the standard library alone.
"""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

INCLUDE = Path(__file__).with_name("include")
"""Folder of the headers that several files include."""

IS_X86 = platform.machine().lower() in ("x86_64", "amd64")

FLAGS = (
    "-std=c++17",
    "-O3",
    "-g0",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wno-psabi",
    # Eight numbers at once, multiplied and added in one rounding: Intel's processors since 2013,
    # AMD's since 2015. With AVX-512 the kernels are no faster, and give the same bits.
    *(("-mavx2", "-mfma") if IS_X86 else ()),
)
"""Flags of the compiler: for any machine of this architecture, as wheels run on others than those
that build them."""


def cpp_files(pattern: str = "*.cpp") -> list[Path]:
    """The C++ files of this package, or its headers, ``*.h``."""
    return sorted(Path(__file__).parents[1].rglob(pattern))


def library_path() -> Path:
    """The library of the C++ files. Its name has a hash of them and of the flags, so one of other
    sources is not taken for it; the dot in it keeps Python from taking it for a module."""
    key = hashlib.sha256(" ".join((platform.system(), platform.machine(), *FLAGS)).encode())
    for path in (*cpp_files(), *cpp_files("*.h")):
        name = path.relative_to(Path(__file__).parents[1]).as_posix()
        key.update(f"\0{name}\0".encode() + path.read_bytes())
    return Path(__file__).with_name(f"kernels.{key.hexdigest()[:16]}.so")
