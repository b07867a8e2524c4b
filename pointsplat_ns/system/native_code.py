"""Builds a C++ file of this package with the machine's compiler, once, and loads it."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from pathlib import Path

CACHE_VARIABLE = "POINTSPLAT_CACHE"
"""Environment variable with the folder for what is built; by default pointsplat_ns in the user's cache folder."""

_FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")

_SHARED = Path(__file__).with_name("include")
"""Folder of the headers that several files include."""


class NativeCodeError(Exception):
    """There is no native code; the text says why, in one line."""


@functools.cache
def load_native(source: Path) -> ctypes.CDLL:
    """Compile a C++ file, unless that was done before, and load it.

    The library lies in a folder of the user's, which others cannot write to, named by a hash of the source, the
    compiler and the processor. Where no such folder can be had it is built anew for each process.

    Args:
        source: the file. It may include headers (``.h``) that lie beside it, or in ``system/include``.

    Raises:
        NativeCodeError: if there is no compiler, or it fails.
    """
    compiler = _compiler()
    machine, macros = _target(compiler)
    texts = [file.read_bytes() for file in (source, *sorted(source.parent.glob("*.h")), *sorted(_SHARED.glob("*.h")))]
    key = hashlib.sha256(b"\0".join([*texts, macros, " ".join((compiler, machine, *_FLAGS)).encode()]))
    name = f"{source.stem}-{key.hexdigest()[:20]}.so"
    folder = _cache_folder()
    with contextlib.ExitStack() as stack:
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pointsplat-")))
        library = folder / name
        try:
            if not library.is_file():
                _build(compiler, machine, source, library)
            return ctypes.CDLL(str(library))
        except OSError as error:
            raise NativeCodeError(f"{library}: {_first_line(str(error))}") from error


def _compiler() -> str:
    """Path of a C++ compiler."""
    named = os.environ.get("CXX")
    found = next(filter(None, map(shutil.which, [named] if named else ("c++", "g++", "clang++"))), None)
    if found is None:
        raise NativeCodeError(f"CXX is {named}, which is not there" if named else "there is no C++ compiler")
    return found


def _target(compiler: str) -> tuple[str, bytes]:
    """The flag for this processor, and what the compiler then defines: its version and what the processor can do."""
    # Flags for code of this very processor: compilers know one or the other.
    for machine in (
        "-march=native",
        "-mcpu=native",
        "",
    ):
        arguments = [compiler, *filter(None, [machine]), "-dM", "-E", "-x", "c++", os.devnull]
        ran = _run(arguments)
        if ran.returncode == 0:
            return machine, ran.stdout
    raise NativeCodeError(f"{compiler}: {_first_line(ran.stderr.decode(errors='replace'))}")


def _build(compiler: str, machine: str, source: Path, library: Path) -> None:
    """Compile beside and rename, so that a library that is there is whole."""
    handle, part = tempfile.mkstemp(dir=library.parent, prefix=".", suffix=".part")
    os.close(handle)
    try:
        ran = _run([compiler, *_FLAGS, f"-I{_SHARED}", *filter(None, [machine]), "-o", part, str(source)])
        if ran.returncode != 0:
            raise NativeCodeError(f"{compiler}: {_first_line(ran.stderr.decode(errors='replace'))}")
        os.replace(part, library)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(part)


def _run(arguments: list[str]) -> subprocess.CompletedProcess[bytes]:
    try:
        # For a compiler.
        return subprocess.run(arguments, capture_output=True, stdin=subprocess.DEVNULL, timeout=120.0, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        raise NativeCodeError(f"{arguments[0]}: {_first_line(str(error))}") from error


def _cache_folder() -> Path | None:
    """A folder that is the user's alone; None if there is none."""
    named = os.environ.get(CACHE_VARIABLE)
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    folder = Path(named) if named else Path(home) / "pointsplat_ns"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.stat()
    except (OSError, RuntimeError):  # the second: a home that is not known
        return None
    shared = about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    ours = not hasattr(os, "getuid") or about.st_uid == os.getuid()
    return folder if ours and not shared and os.access(folder, os.W_OK) else None


def _first_line(text: str) -> str:
    """The first line that says something, cut to a readable length."""
    return next((line.strip() for line in text.splitlines() if line.strip()), "no reason given")[:200]
