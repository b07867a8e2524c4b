"""Claims on pieces of work that several processes, on one or more machines, share by a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def claim(path: Path, wait: bool = False) -> Iterator[bool]:
    """Hold the lock of a file, whose missing folders are created, while the context is open. Yields whether the lock is
    held here; always true with ``wait``, for a lock that another process holds.

    The operating system holds the lock, so that it ends with the process, however that ends. Between machines this
    holds as far as the file system that they share passes locks on. The file stays. It may be removed only while it is
    held, and only if whoever gets the lock of the removed file sees that there is nothing left to do. Raises OSError if
    the file system has no locks, or the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with claim(Path(folder, "lock")) as first, claim(Path(folder, "lock")) as second:
        ...         first, second
        (True, False)
    """
    from filelock import FileLock, Timeout

    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=-1 if wait else 0)
    except Timeout:
        yield False
        return
    except NotImplementedError as error:
        raise OSError(f"{path}: its file system has no locks") from error
    try:
        yield True
    finally:
        lock.release()
