"""Claims: a command holds the files and folders that it is going to write, from before its work until it ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import never_replaced, one_line, target_of
from pointsplat_ns.system.claims import claim

LOCK_NAME = ".pointsplat.lock"
"""Lock file in a claimed folder."""


def need_suffix(path: Path, suffix: str) -> None:
    """Raise a SceneError if a path does not end in a suffix, such as ``.png``."""
    if path.suffix.lower() != suffix:
        what = f"a {path.suffix or 'nameless'} file"
        raise SceneError(f"{path}: cannot write {what}; expected a name that ends in {suffix}")


def need_new(path: Path, force: bool) -> None:
    """Raise a SceneError if a path exists and may not be replaced."""
    if target_of(path).exists() and not force:
        raise SceneError(f"{path}: exists already; name another file, or overwrite it with --force")


@contextmanager
def claimed(path: Path, force: bool = False) -> Iterator[None]:
    """Hold a file that will be written, so that another process that claims it fails at once.

    The lock is a hidden file beside it. The system releases it when the process ends, however that happens.

    Args:
        path: the file. Missing folders are created, and removed if they are empty in the end.
        force: whether an existing file may be replaced. If not, a file that appears meanwhile is not replaced either
            (:func:`~pointsplat_ns.io.files.never_replaced`).

    Raises:
        SceneError: if another process holds it, it cannot be written, it is a folder, a pipe or a device, or it exists
            and may not be replaced.
    """
    name = path.name.encode("utf-8", "surrogateescape")[:200].decode("utf-8", "ignore")
    with ExitStack() as stack:
        try:
            target = target_of(path)
            stack.enter_context(_locked(target.with_name(f".{name}.lock"), path))
            need_new(path, force)
        except OSError as error:
            raise SceneError(f"{path}: cannot be written ({error.strerror or one_line(error)})") from error
        if not force:
            stack.enter_context(never_replaced(path))
        yield


@contextmanager
def claimed_folder(path: Path) -> Iterator[None]:
    """Hold a folder that will be written to, as :func:`claimed` holds a file.

    Raises:
        SceneError: if another process holds it, it is a file, or nothing can be written there.
    """
    with ExitStack() as stack:
        try:
            if path.exists() and not path.is_dir():
                raise SceneError(f"{path}: is a file; expected the name of a folder")
            stack.enter_context(_locked(path / LOCK_NAME, path))
        except OSError as error:
            raise SceneError(f"{path}: cannot be written ({error.strerror or one_line(error)})") from error
        yield


@contextmanager
def _locked(lock: Path, output: Path) -> Iterator[None]:
    missing = [folder for folder in lock.parents if not folder.exists()]
    try:
        with claim(lock) as held:
            if not held:
                raise SceneError(f"{output}: another process is writing it; wait for it, or name another output")
            try:
                yield
            finally:
                with suppress(OSError):  # Windows keeps a file that is open
                    lock.unlink()
    finally:
        with suppress(OSError):  # the first that is not empty ends it
            for folder in missing:
                folder.rmdir()
