"""Libraries of C++ files of this package: built by the machine's compiler, and kept in a folder of the user's."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import shutil
import stat
import subprocess
import tempfile
import time
from pathlib import Path

logger = logging.getLogger("pointsplat_ns")

_FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")

_SHARED = Path(__file__).with_name("include")
"""Folder of the headers that several files include."""


_STALE = 3600.0
"""Age of an unfinished file in seconds from which on nobody works on it: a compiler is ended after minutes."""


class NativeCodeError(Exception):
    """There is no native code; the text says why, in one line."""


class NoCompilerError(NativeCodeError):
    """This machine has no C++ compiler."""


@functools.cache
def load_native(source: Path) -> ctypes.CDLL:
    """Compile a C++ file, which may include headers (``.h``) that lie beside it or in ``include``, unless that was done
    before, and load it.

    The library lies in a folder of the user's, which others cannot write to. Its name has a hash of the source, the
    compiler and the processor, and one of its own bytes; one with other bytes was damaged, and is built again. Where no
    such folder can be had it is built anew for each process. Raises NativeCodeError if there is no compiler, or it
    fails.
    """
    compiler = _compiler()
    machine, macros = _target(compiler)
    texts = [file.read_bytes() for file in (source, *sorted(source.parent.glob("*.h")), *sorted(_SHARED.glob("*.h")))]
    key = hashlib.sha256(b"\0".join([*texts, macros, " ".join((compiler, machine, *_FLAGS)).encode()]))
    name = f"{source.stem}-{key.hexdigest()[:20]}"
    folder = cache_folder()
    with contextlib.ExitStack() as stack:
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pointsplat-")))
        try:
            return ctypes.CDLL(str(_kept(folder, name) or _build(compiler, machine, source, folder / name)))
        except OSError as error:
            raise NativeCodeError(f"{folder / name}: {_first_line(str(error))}") from error


def _kept(folder: Path, name: str) -> Path | None:
    """The whole library of a name in a folder, None if there is none; damaged ones are removed. To load one ends the
    program (SIGBUS) if it was cut."""
    for found in sorted(folder.glob(f"{name}-*.so")):
        if found.name == f"{name}-{_digest(found)}.so":
            return found
        logger.warning("%s: damaged, so it is built again", found)
        found.unlink(missing_ok=True)
    return None


def _digest(library: Path) -> str:
    """SHA-256 of a file, in 64 hexadecimal digits."""
    return hashlib.sha256(library.read_bytes()).hexdigest()


def _compiler() -> str:
    """Path of a C++ compiler."""
    named = os.environ.get("CXX")
    found = next(filter(None, map(shutil.which, [named] if named else ("c++", "g++", "clang++"))), None)
    if found is None:
        if named:
            raise NativeCodeError(f"CXX is {named}, which is not there")
        raise NoCompilerError("there is no C++ compiler")
    return found


@functools.cache
def _target(compiler: str) -> tuple[str, bytes]:
    """The flag for this processor, and what the compiler then defines: its version and what the processor can do."""
    # Flags for code of this very processor: compilers know one or the other.
    for machine in ("-march=native", "-mcpu=native", ""):
        arguments = [compiler, *filter(None, [machine]), "-dM", "-E", "-x", "c++", os.devnull]
        ran = _run(arguments)
        if ran.returncode == 0:
            return machine, ran.stdout
    raise NativeCodeError(f"{compiler}: {_first_line(ran.stderr.decode(errors='replace'))}")


def _build(compiler: str, machine: str, source: Path, place: Path) -> Path:
    """Compile beside ``place``, and give the library its name when all of it is on the disk. Returns its path."""
    for left in place.parent.glob(".*.part"):  # by a process that was killed
        with contextlib.suppress(OSError):
            if time.time() - left.lstat().st_mtime > _STALE:
                left.unlink()
    handle, part = tempfile.mkstemp(dir=place.parent, prefix=".", suffix=".part")
    try:
        ran = _run([compiler, *_FLAGS, f"-I{_SHARED}", *filter(None, [machine]), "-o", part, str(source)])
        if ran.returncode != 0:
            raise NativeCodeError(f"{compiler}: {_first_line(ran.stderr.decode(errors='replace'))}")
        library = place.with_name(f"{place.name}-{_digest(Path(part))}.so")
        with open(part, "rb") as stream:  # another file than that of the handle: linkers replace it
            os.fsync(stream.fileno())
        os.replace(part, library)
        return library
    finally:
        os.close(handle)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(part)


def _run(arguments: list[str]) -> subprocess.CompletedProcess[bytes]:
    try:
        return subprocess.run(arguments, capture_output=True, stdin=subprocess.DEVNULL, timeout=120.0, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        raise NativeCodeError(f"{arguments[0]}: {_first_line(str(error))}") from error


def cache_folder() -> Path | None:
    """The folder for built libraries, which is the user's alone: that of the environment variable POINTSPLAT_CACHE, by
    default pointsplat_ns in the user's cache folder. None if there is none."""
    named = os.environ.get("POINTSPLAT_CACHE")
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
