"""The package's C++ files, and the library that is compiled from them at installation.

``setup.py`` runs this file on its own, so it imports only the standard library.
"""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

INCLUDE = Path(__file__).with_name("include")
"""Folder of the shared headers."""

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
"""Compiler flags, for any machine of this architecture, because wheels are built on other machines
than they run on."""


def cpp_files(pattern: str = "*.cpp") -> list[Path]:
    """The C++ files of this package, or its headers for ``*.h``."""
    return sorted(Path(__file__).parents[1].rglob(pattern))


def library_path() -> Path:
    """Library of the C++ files. Its name contains a hash of the files and the flags, so that an
    outdated library is not loaded; the dot in the name keeps Python from importing it as a
    module."""
    key = hashlib.sha256(" ".join((platform.system(), platform.machine(), *FLAGS)).encode())
    for path in (*cpp_files(), *cpp_files("*.h")):
        name = path.relative_to(Path(__file__).parents[1]).as_posix()
        key.update(f"\0{name}\0".encode() + path.read_bytes())
    return Path(__file__).with_name(f"kernels.{key.hexdigest()[:16]}.so")
