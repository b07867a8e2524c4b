"""Claims on pieces of work that several processes, on one or more machines, share by a folder."""

from __future__ import annotations

import errno
import os
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


@contextmanager
def claim(path: Path, wait: bool = False) -> Iterator[bool]:
    """Hold the lock of a file, whose missing folders are created, while the context is open. Yields whether the lock is
    held here; always true with ``wait``, for a lock that another process or thread holds.

    The operating system holds the lock, so that it ends with the process, however that ends. Between machines this
    holds as far as the file system that they share passes locks on. The file stays; whoever holds it may remove it.
    Whatever lies at the path, nothing is written to it, and a link is not followed: others may have put it there.

    Args:
        path: the file.
        wait: wait until nobody else holds it.

    Raises:
        OSError: if the file system has no locks, the file cannot be written, or is a link, a pipe or a device.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with claim(Path(folder, "lock")) as first, claim(Path(folder, "lock")) as second:
        ...         first, second
        (True, False)
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        descriptor = _opened(path)
        try:
            held = _locked(descriptor, wait)
            if held and not _is_at(descriptor, path):  # it was removed or replaced meanwhile
                continue
            yield held
            return
        finally:
            os.close(descriptor)  # which ends the lock


def _opened(path: Path) -> int:
    """A descriptor of a regular file, which is created if there is none, and is neither emptied nor changed."""
    flags = os.O_RDWR
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_NOINHERIT"):
        flags |= getattr(os, name, 0)
    while True:
        try:
            descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            if path.is_symlink():
                raise OSError(errno.ELOOP, f"its lock {path.name} is a link, remove it", str(path)) from None
            try:
                descriptor = os.open(path, flags)
            except FileNotFoundError:  # removed meanwhile
                continue
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise OSError(errno.EINVAL, f"its lock {path.name} is not a regular file, remove it", str(path))
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether a path still leads to an open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


if sys.platform == "win32":

    def _locked(descriptor: int, wait: bool) -> bool:
        """Lock an open file. Returns whether it is locked, always true with ``wait``."""
        while True:
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
                return True
            except OSError:
                if not wait:
                    return False
            time.sleep(0.05)

else:

    def _locked(descriptor: int, wait: bool) -> bool:
        """Lock an open file. Returns whether it is locked, always true with ``wait``."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return False
        return True
