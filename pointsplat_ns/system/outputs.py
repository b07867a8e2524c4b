"""Output names: a command claims them while it works, and writes them only if they are still free.

A claim is a lock on a hidden file beside the output. It refuses a second command early, but gives
no guarantee: if a claim cannot be made, it is skipped, and the claim of a killed command is taken
over. The guarantee is the last step, which never replaces a file that appeared meanwhile.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from pointsplat_ns.errors import SceneError


@dataclass
class _Claim:
    """A claimed output name."""

    lock: int | None = None
    """Descriptor of the locked file; None without a lock."""
    file: Path | None = None
    """The locked file."""
    folders: list[Path] = field(default_factory=list)
    """Folders created for it, outermost first."""

    def release(self) -> None:
        """Release the name. Folders created for it stay."""
        if self.lock is not None and self.file is not None:
            with suppress(OSError):
                self.file.unlink()
            os.close(self.lock)
            self.lock = None


@dataclass
class _Outputs:
    """The outputs of one command."""

    claims: dict[str, _Claim] = field(default_factory=dict)
    """Names that were free when the command began, by absolute path."""
    unnamed: set[str] = field(default_factory=set)
    """Automatically named files, absolute paths."""


_outputs: ContextVar[_Outputs | None] = ContextVar("outputs", default=None)


@contextmanager
def outputs_claimed() -> Iterator[None]:
    """Inside of this context, :func:`claim` claims names for this command. A nested context changes
    nothing."""
    if _outputs.get() is not None:
        yield
        return
    outputs = _Outputs()
    token = _outputs.set(outputs)
    try:
        yield
    finally:
        _outputs.reset(token)
        for one in outputs.claims.values():
            one.release()
        for one in outputs.claims.values():  # claims may share a folder
            remove_empty(one.folders)


def claim(path: Path) -> None:
    """Claim a name for this command until its :func:`outputs_claimed` context ends; no effect
    outside of one. Raises SceneError if another command on this machine has claimed it."""
    outputs = _outputs.get()
    key = os.path.abspath(path)
    if outputs is None or key in outputs.claims:
        return
    one = _Claim()
    outputs.claims[key] = one
    with suppress(OSError):
        one.folders = make_folders(Path(key).parent)
        one.file = Path(key).with_name(f".{short_name(Path(key))}.claim.part")
        one.lock = _locked(one.file, path)


def is_claimed(path: Path) -> bool:
    """Whether this command has claimed a name and not written it yet."""
    outputs = _outputs.get()
    return outputs is not None and os.path.abspath(path) in outputs.claims


def written(path: Path) -> None:
    """Release the claim on a name: the file exists, and this command may replace it."""
    outputs = _outputs.get()
    if outputs is not None and (one := outputs.claims.pop(os.path.abspath(path), None)):
        one.release()


def unnamed(path: Path) -> Path:
    """Mark ``path`` as automatically named in this command, and return it. A symbolic link there is
    untrusted."""
    outputs = _outputs.get()
    if outputs is not None:
        outputs.unnamed.add(os.path.abspath(path))
    return path


def is_unnamed(path: Path) -> bool:
    """Whether this command marked the path with :func:`unnamed`."""
    outputs = _outputs.get()
    return outputs is not None and os.path.abspath(path) in outputs.unnamed


def is_own_file(path: Path) -> bool:
    """Whether the path is a regular file, not a link to one: automatically named files are not read
    through links."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


def remove_own(path: Path) -> None:
    """Remove a file that a command left, or a symbolic link in its place; anything else, such as a
    folder, stays."""
    with suppress(OSError):
        path.unlink()


def need_no_links(folder: Path, path: Path) -> None:
    """Raise a SceneError if a folder between ``folder`` and ``path`` below it is a symbolic link,
    because the user did not name it."""
    for place in path.parents:
        if place == folder:
            return
        if place.is_symlink():
            raise SceneError(
                f"{path}: {place} is a link to {os.path.realpath(place)}; remove it, or name "
                "another folder for the results"
            )


def short_name(path: Path) -> str:
    """Name of a path, cut so that a hidden name derived from it stays below the file system's limit
    of 255 bytes."""
    return path.name.encode("utf-8", "surrogateescape")[:200].decode("utf-8", "ignore")


def make_folders(folder: Path) -> list[Path]:
    """Create a folder and its missing parents; returns the created folders, outermost first. Raises
    OSError if one cannot be created."""
    missing = [place for place in (folder, *folder.parents) if not os.path.lexists(place)][::-1]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def remove_empty(folders: list[Path]) -> None:
    """Remove the empty ones of the folders that :func:`make_folders` returned."""
    for folder in reversed(folders):
        with suppress(OSError):
            folder.rmdir()


def put_new(part: Path, target: Path) -> None:
    """Move a finished file to its name atomically, unless the name is taken. The temporary name may
    remain. Raises FileExistsError if the name is taken, and OSError if moving fails."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        try:
            os.replace(part, target)
        except BaseException:
            with suppress(OSError):
                target.unlink()
            raise


def appeared(path: Path) -> SceneError:
    """The error for a name that was free when the command began, and is taken now."""
    return SceneError(
        f"{path}: another file of this name appeared meanwhile; it is not replaced; choose another "
        "name, or overwrite it with --force"
    )


def put_folder(part: Path, target: Path, last: str, ours: str, force: bool) -> None:
    """Move a finished folder to its name, or its files into an existing folder.

    An existing folder that contains only our files is replaced in one step, if the system can
    exchange two names (Linux, macOS). Otherwise entries are replaced one by one, ``last`` at the
    end, and an error or a signal restores the previous entries.

    Args:
        part: the finished folder, beside ``target``; receives the replaced entries.
        target: not a symbolic link.
        last: the index file.
        ours: pattern of the entry names that may be replaced or removed.
        force: whether to replace entries.

    Raises:
        FileExistsError: if an entry exists that may not be replaced.
        OSError: if files cannot be renamed.
    """
    if not os.path.lexists(target):
        with suppress(OSError):  # the name was taken meanwhile
            os.rename(part, target)
            return
    found = os.listdir(target)
    alone = all(re.fullmatch(ours, name) for name in found)
    here = Path(os.path.realpath(os.curdir))
    used = target in (here, *here.parents)
    if (force or not found) and alone and not used:
        part.chmod(stat.S_IMODE(target.stat().st_mode))
        if _exchanged(part, target):
            return
    _put_entries(part, target, last, force)


def _put_entries(part: Path, target: Path, last: str, force: bool) -> None:
    """Move all entries of a folder into another one, ``last`` at the end, or none."""
    names = sorted(os.listdir(part), key=lambda name: (name == last, name))
    aside = part / f".{secrets.token_hex(4)}"
    aside.mkdir()
    try:
        if force:  # without the index file, the others are not taken as complete
            _rename_present(target / last, aside / last)
        for name in names:
            if force:
                _rename_present(target / name, aside / name)
                os.rename(part / name, target / name)
            else:
                _put_entry(part / name, target / name)
    except BaseException:  # the interrupted step may be done or not
        for name in reversed(names):
            with suppress(OSError):
                if not os.path.lexists(part / name):
                    os.rename(target / name, part / name)
                elif os.path.samestat(os.lstat(part / name), os.lstat(target / name)):
                    os.unlink(target / name)
        for name in os.listdir(aside):
            with suppress(OSError):
                os.rename(aside / name, target / name)
        raise


def _rename_present(path: Path, other: Path) -> None:
    """Rename a path if it exists."""
    if os.path.lexists(path):
        os.rename(path, other)


def _put_entry(part: Path, target: Path) -> None:
    """Move a file or a folder to its name. Raises FileExistsError if the name is taken."""
    try:
        if os.path.lexists(target):
            raise FileExistsError
        if part.is_dir():
            os.rename(part, target)
        else:
            put_new(part, target)
    except OSError as error:
        if not os.path.lexists(target):
            raise
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from error


def _exchanged(first: Path, second: Path) -> bool:
    """Exchange the names of two folders in one step; False if the system or the file system cannot
    do it."""
    names = os.fsencode(first), os.fsencode(second)
    exchange = 2  # RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS
    try:
        libc = ctypes.CDLL(None)
        if sys.platform == "linux":
            here = -100  # AT_FDCWD
            return bool(libc.renameat2(here, names[0], here, names[1], exchange) == 0)
        if sys.platform == "darwin":
            return bool(libc.renamex_np(*names, exchange) == 0)
    except (AttributeError, OSError, TypeError):
        pass
    return False


def _locked(file: Path, path: Path) -> int | None:
    """Descriptor of a file, created if missing, and locked until it is closed; None if locking is
    not possible here. Raises SceneError about ``path`` if another process holds the lock."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    flags = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    for _ in range(10):
        number = os.open(file, flags, 0o644)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(number), os.lstat(file)):
                return number
        except BlockingIOError as error:
            os.close(number)
            raise SceneError(
                f"{path}: another command is writing it; choose another name, or wait for its end"
            ) from error
        except FileNotFoundError:  # the command that held it has just ended
            pass
        except OSError:  # a file system without locks
            os.close(number)
            return None
        os.close(number)
    return None


@contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """A new hidden folder beside ``target``, removed at the end together with the parent folders
    created for it that are empty. Raises OSError if it cannot be created."""
    made = make_folders(target.parent)
    part = target.parent / f".{short_name(target)}.{os.getpid()}-{secrets.token_hex(4)}.part"
    try:
        part.mkdir()
        yield part
    finally:
        shutil.rmtree(part, ignore_errors=True)
        remove_empty(made)
