"""Names of outputs: a command claims them while it works, and takes them at its end only if they are
still free.

A claim is a lock on a hidden file beside the output. It refuses a second command early, and is no
promise: a claim that cannot be made is left out, and one that a killed command left is taken over.
What holds always is the last step, which never replaces a file that has appeared meanwhile.
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
    """A name that one command writes."""

    lock: int | None = None
    """Descriptor of the locked file; None without a lock."""
    file: Path | None = None
    """The locked file."""
    folders: list[Path] = field(default_factory=list)
    """Folders that were made for it, the outermost first."""

    def release(self) -> None:
        """Give the name back. Folders that were made for it stay."""
        if self.lock is not None and self.file is not None:
            with suppress(OSError):
                self.file.unlink()
            os.close(self.lock)
            self.lock = None


@dataclass
class _Outputs:
    """The outputs of one command."""

    claims: dict[str, _Claim] = field(default_factory=dict)
    """By absolute path, the names that were free when the command began."""
    unnamed: set[str] = field(default_factory=set)
    """Absolute paths that the program chose."""


_outputs: ContextVar[_Outputs | None] = ContextVar("outputs", default=None)


@contextmanager
def outputs_claimed() -> Iterator[None]:
    """While this is open, names that :func:`claim` was called with are those of this command. Where
    one is open already, nothing changes."""
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
    """Claim a name for this command until its :func:`outputs_claimed` is closed; nothing happens if
    none is open. Raises SceneError if another command of this machine has claimed it."""
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
    """Whether this command claimed a name, and has not written it yet."""
    outputs = _outputs.get()
    return outputs is not None and os.path.abspath(path) in outputs.claims


def written(path: Path) -> None:
    """Give back the claim on a name: the file is there, and may be replaced by this command."""
    outputs = _outputs.get()
    if outputs is not None and (one := outputs.claims.pop(os.path.abspath(path), None)):
        one.release()


def unnamed(path: Path) -> Path:
    """``path``, after it was noted for this command that nobody named it: a symbolic link there is
    a stranger's."""
    outputs = _outputs.get()
    if outputs is not None:
        outputs.unnamed.add(os.path.abspath(path))
    return path


def is_unnamed(path: Path) -> bool:
    """Whether :func:`unnamed` was called with this path in this command."""
    outputs = _outputs.get()
    return outputs is not None and os.path.abspath(path) in outputs.unnamed


def is_own_file(path: Path) -> bool:
    """Whether there is a regular file, and no symbolic link to one: what nobody named is not read
    through a link."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


def remove_own(path: Path) -> None:
    """Remove a file that a command left, or a symbolic link in its place; what else is there, such
    as a folder, stays."""
    with suppress(OSError):
        path.unlink()


def need_no_links(folder: Path, path: Path) -> None:
    """Raise a SceneError if a folder between ``folder`` and ``path``, which lies below it, is a
    symbolic link: nobody named it."""
    for place in path.parents:
        if place == folder:
            return
        if place.is_symlink():
            raise SceneError(
                f"{path}: {place} is a link to {os.path.realpath(place)}; remove it, or name "
                "another folder for the results"
            )


def short_name(path: Path) -> str:
    """The name of a path, cut so that a hidden name can be made of it: file systems allow 255
    bytes."""
    return path.name.encode("utf-8", "surrogateescape")[:200].decode("utf-8", "ignore")


def make_folders(folder: Path) -> list[Path]:
    """Make a folder and those above it; returns those that were missing, the outermost first.
    Raises OSError if one cannot be made."""
    missing = [place for place in (folder, *folder.parents) if not os.path.lexists(place)][::-1]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def remove_empty(folders: list[Path]) -> None:
    """Remove those of some folders that are empty; ``folders`` as of :func:`make_folders`."""
    for folder in reversed(folders):
        with suppress(OSError):
            folder.rmdir()


def put_new(part: Path, target: Path) -> None:
    """Give a finished file its name, in one step, unless there is something of this name. The
    temporary name may stay. Raises FileExistsError if there is, and OSError if it cannot be
    done."""
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
    """The error for a name that was free when the command began, and is not now."""
    return SceneError(
        f"{path}: another file of this name has appeared meanwhile, and stays; name another one, "
        "or overwrite it with --force"
    )


def put_folder(part: Path, target: Path, last: str, ours: str, force: bool) -> None:
    """Give a finished folder its name, or its files their place in a folder that is there.

    A folder that holds nothing else than files of ours is replaced in one step, where the system
    can exchange two names (Linux, macOS). Otherwise entries are replaced one by one, ``last`` at
    the end, and an error or a signal puts back what was there.

    Args:
        part: the finished folder, beside ``target``; what was replaced is in it afterwards.
        target: no symbolic link.
        last: the entry that tells of all others.
        ours: pattern of the names of entries that may be replaced or removed.
        force: whether entries may be replaced.

    Raises:
        FileExistsError: if there is an entry that may not be replaced.
        OSError: if files cannot be renamed.
    """
    if not os.path.lexists(target):
        with suppress(OSError):  # something has appeared after all
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
    """Put the entries of a folder into another one, ``last`` at the end, or none."""
    names = sorted(os.listdir(part), key=lambda name: (name == last, name))
    aside = part / f".{secrets.token_hex(4)}"
    aside.mkdir()
    try:
        if force:  # without the last one nobody takes the others for whole
            _rename_present(target / last, aside / last)
        for name in names:
            if force:
                _rename_present(target / name, aside / name)
                os.rename(part / name, target / name)
            else:
                _put_entry(part / name, target / name)
    except BaseException:  # the interrupted step may have been taken or not
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
    """Rename what is there, if anything is."""
    if os.path.lexists(path):
        os.rename(path, other)


def _put_entry(part: Path, target: Path) -> None:
    """Give a file or a folder its name. Raises FileExistsError if there is something."""
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
    """Whether two folders have exchanged their names, in one step; False where the system or the
    file system cannot."""
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
    """A descriptor of a file that is made if it is missing and locked until it is closed; None if
    that is not possible here. Raises SceneError, about ``path``, if another process has locked
    it."""
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
                f"{path}: another command is writing it; name another one, or wait for its end"
            ) from error
        except FileNotFoundError:  # the command that had it has ended just now
            pass
        except OSError:  # a file system without locks
            os.close(number)
            return None
        os.close(number)
    return None


@contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """A new hidden folder beside ``target``, removed at the end, with folders above that were made
    for it if they are empty then. Raises OSError if it cannot be made."""
    made = make_folders(target.parent)
    part = target.parent / f".{short_name(target)}.{os.getpid()}-{secrets.token_hex(4)}.part"
    try:
        part.mkdir()
        yield part
    finally:
        shutil.rmtree(part, ignore_errors=True)
        remove_empty(made)
