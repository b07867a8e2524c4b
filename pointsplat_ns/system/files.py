"""Shared by readers and writers: checks of paths and free space, hashes, atomic writes."""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.system.opening import open_regular
from pointsplat_ns.system.outputs import (
    appeared,
    claim,
    is_claimed,
    is_unnamed,
    make_folders,
    put_folder,
    put_new,
    remove_empty,
    short_name,
    temporary_folder,
    written,
)

logger = logging.getLogger("pointsplat_ns")


def require_file(path: Path | str, what: str) -> Path:
    """``path`` as a Path. Raises SceneError, with ``what`` was expected, if it is not a regular
    file."""
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path}: no such file; expected {what}")
    if not path.is_file():
        raise SceneError(f"{path}: not a regular file; expected {what}")
    return path


def read_text(path: Path, most: int = 1 << 26) -> str:
    """Text of a small file. Never opens pipes or devices, which may not end.

    Args:
        path: the file, in UTF-8.
        most: maximum size, bytes.

    Raises:
        OSError: if it is missing, a folder, a pipe or a device, or cannot be read.
        ValueError: if it is larger, or not text.
    """
    with open_regular(path) as stream:
        content = stream.read(most + 1)
    if len(content) > most:
        raise ValueError(f"larger than {most:,} bytes")
    return content.decode("utf-8")


@contextmanager
def failure_named(path: Path, what: str) -> Iterator[None]:
    """Turn an OSError into a SceneError: ``path`` cannot be ``what``, such as "read", and why."""
    try:
        yield
    except OSError as error:
        raise SceneError(
            f"{path}: cannot be {what} ({error.strerror or one_line(error)})"
        ) from error


def require_memory(path: Path | str, size: int) -> None:
    """Raise a SceneError if less than ``size`` bytes of memory are free for a file's content. The
    declared size need not be real: zeros of a sparse file take no disk space."""
    import psutil

    free = psutil.virtual_memory().available
    if size > free:
        raise SceneError(
            f"{path}: takes {size / 1e9:.1f} GB of memory, {free / 1e9:.1f} GB are free; expected "
            "a file that fits"
        )


def content_hash(path: Path | str) -> str:
    """SHA-256 of a file's bytes, as 64 hexadecimal digits. Reads the file in pieces, so it need not
    fit into memory.

    Raises:
        SceneError: if the file is missing or cannot be read.
    """
    path = require_file(path, "a scene to read")
    digest = hashlib.sha256()
    with failure_named(path, "read"), open_regular(path) as stream:
        while piece := stream.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def one_line(error: BaseException, limit: int = 160) -> str:
    """First line of an exception's text, at most ``limit`` characters; its type name if the text is
    empty."""
    lines = str(error).strip().splitlines()
    text = lines[0].strip() if lines else type(error).__name__
    return text if len(text) <= limit else text[: limit - 3] + "..."


def file_stem(text: str) -> str:
    """``text`` as a file name: characters other than letters, digits and ``_ . + -`` become ``-``;
    "scene" if the result is empty."""
    return re.sub(r"[^\w.+-]+", "-", text).strip("-.") or "scene"


@contextmanager
def replacing(
    path: Path | str,
    size: int = 0,
    folder: Path | None = None,
    named: bool = True,
    new: bool = False,
) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to. It replaces ``path`` if the block ends without
    an error, and is removed otherwise.

    Missing parent folders are created, and removed after an error if they are empty. A symbolic
    link is followed: its target is replaced. A replaced file keeps its mode. Concurrent writers of
    one path use different temporary paths, and the last one wins. A name that
    :func:`need_writable` claimed is written only if it is still free.

    Args:
        path: the file.
        size: number of bytes to be written, if known; they must be free.
        folder: folder of the temporary path, on the same file system; by default that of ``path``.
        named: whether the user named the file. If not, a symbolic link is itself replaced, because
            it may come from elsewhere, as in a downloaded folder.
        new: whether to refuse replacing a file, as for a claimed name.

    Raises:
        SceneError: if ``path`` is a folder or a device, cannot be written, or may not be replaced.
    """
    path = Path(path)
    part: Path | None = None
    made: list[Path] = []
    done = False
    new = new or is_claimed(path)
    try:
        with failure_named(path, "written"):
            foreign = not (named and not is_unnamed(path)) and path.is_symlink()
            target = path if foreign or new else _target_of(path)
            mode = None if foreign or new else _mode_of(target)
            made = make_folders(target.absolute().parent)
            require_space(path, target.parent, size)
            # Unique over processes, threads and machines.
            name = f".{short_name(target)}.{os.getpid()}-{secrets.token_hex(4)}.part"
            part = (folder or target.parent) / name
            if mode is not None:
                part.touch(0o600)  # unreadable for others until it is complete
            yield part
            if mode is not None:
                part.chmod(mode)
            if not new:
                os.replace(part, target)
                done = True
                return
            try:
                put_new(part, target)
            except FileExistsError as error:
                raise appeared(path) from error
            done = True
            written(path)
    finally:
        if part is not None:
            with suppress(OSError):  # it may not exist; the error above says why
                part.unlink()
        if not done:
            remove_empty(made)


@contextmanager
def replacing_folder(
    folder: Path, last: str, ours: str, force: bool, named: bool = True
) -> Iterator[Path]:
    """A temporary folder beside ``folder`` to write to. If the block ends without an error, its
    files move to ``folder``. After an error or a signal, ``folder`` has its previous files, see
    :func:`~pointsplat_ns.system.outputs.put_folder`.

    Args:
        folder: created if missing.
        last: the index file.
        ours: pattern of the file names that an earlier call wrote.
        force: whether to replace these files.
        named: whether the user named the folder. If not, it must not be a symbolic link.

    Raises:
        SceneError: if the folder cannot be written, or has files that may not be replaced.
    """
    folder = Path(folder)
    need_folder(folder, named)
    target = Path(os.path.realpath(folder))
    with failure_named(folder, "written"), temporary_folder(target) as part:
        try:
            yield part
        except SceneError as error:  # about a file that has no name yet
            raise SceneError(f"{error}".replace(str(part), str(folder))) from error
        try:
            put_folder(part, target, last, ours, force)
        except FileExistsError as error:
            raise appeared(folder / Path(error.filename).name) from error
    written(folder)


def need_suffix(path: Path, suffix: str) -> None:
    """Raise a SceneError if a path does not end in a suffix, such as ``.png``."""
    if path.suffix.lower() != suffix:
        what = f"a {path.suffix or 'nameless'} file"
        raise SceneError(f"{path}: cannot write {what}; expected a name that ends in {suffix}")


def need_new(path: Path, force: bool) -> None:
    """Raise a SceneError if a path exists, unless ``force``. Otherwise claim its name, see
    :func:`~pointsplat_ns.system.outputs.claim`, unless it may be replaced."""
    target = _target_of(path)
    if not force and not target.exists():
        claim(path)
    if not force and target.exists():  # also if another command has just written it
        raise SceneError(f"{path}: exists already; name another file, or overwrite it with --force")


def need_writable(path: Path, force: bool) -> None:
    """Raise a SceneError if a file cannot be written: it is a folder, a pipe or a device, its
    folder is not writable, or it exists and ``force`` is not set."""
    with failure_named(path, "written"):
        _need_place(path, _target_of(path).absolute().parent)
        need_new(path, force)


def need_folder(path: Path, named: bool = True) -> None:
    """Raise a SceneError if a folder, which may be missing, is not writable, or if it is a symbolic
    link and the user has not ``named`` it."""
    if path.is_symlink() and (not named or is_unnamed(path)):
        raise SceneError(
            f"{path}: a link to {os.path.realpath(path)}, which the command did not name; remove "
            "it, or name the folder with --output"
        )
    if os.path.lexists(path) and not path.is_dir():
        raise SceneError(f"{path}: is a file; expected the name of a folder")
    with failure_named(path, "written"):
        _need_place(path, path.absolute())


def _need_place(path: Path, folder: Path) -> None:
    """Raise a SceneError about ``path`` if a folder cannot be written to or created."""
    above = next(place for place in (folder, *folder.parents) if place.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        why = "is not a folder" if not above.is_dir() else "is not writable"
        raise SceneError(f"{path}: cannot be written ({above} {why})")


def _target_of(path: Path) -> Path:
    """The file to write for ``path``: the target of a symbolic link, else ``path`` itself.

    Raises:
        SceneError: if it is a folder, a device or a pipe, a broken link, or not a valid file name.
    """
    if "\0" in str(path):
        raise SceneError(
            f"{str(path)!r}: contains a NUL character; expected the name of a file to write"
        )
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    # a link from elsewhere may aim at creating its target
    if target != path and not os.path.lexists(target):
        raise SceneError(f"{path}: a broken link to {target}; remove it, or name that file")
    if target.is_dir():
        raise SceneError(f"{path}: is a folder; expected the name of a file to write")
    _mode_of(target)
    return target


def require_space(path: Path, folder: Path, size: int) -> None:
    """Raise a SceneError if the disk has less than ``size`` bytes free. A replaced file takes space
    until the end."""
    disk = shutil.disk_usage(folder)
    if disk.total and size > disk.free:  # some network file systems report zeros
        raise SceneError(
            f"{path}: needs {bytes_text(size)}, {bytes_text(disk.free)} are free there, so nothing "
            "was written; make room or name another place"
        )


def bytes_text(size: float) -> str:
    """A number of bytes in kB, MB or GB (powers of 1000), with three digits.

    Example:
        >>> bytes_text(3_847), bytes_text(113_400_000), bytes_text(2.5e9)
        ('3.85 kB', '113 MB', '2.50 GB')
    """
    factor, unit = next(
        (pair for pair in ((1e9, "GB"), (1e6, "MB")) if size >= pair[0]), (1e3, "kB")
    )
    return f"{three_digits(size / factor)} {unit}"


def three_digits(value: float) -> str:
    """A positive number with three significant digits, or all digits of a larger integer part.

    Example:
        >>> three_digits(0.3964), three_digits(14.27), three_digits(9999.6)
        ('0.396', '14.3', '10,000')
    """
    decimals = max(0, 2 - math.floor(math.log10(value))) if value > 0 else 0
    return f"{value:,.{decimals}f}"


def _mode_of(path: Path) -> int | None:
    """Permission bits of a file to be replaced; None if it does not exist. Raises SceneError if it
    is not a regular file."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(status.st_mode):
        raise SceneError(f"{path}: not a regular file; expected the name of a file to write")
    return stat.S_IMODE(status.st_mode)


def json_text(content: Any) -> str:
    """JSON of numbers, text, paths and collections of them, with null for NaN and infinities.

    Example:
        >>> print(json_text({"psnr": float("inf"), "output": Path("room.ply")}))
        {
          "psnr": null,
          "output": "room.ply"
        }
    """
    return json.dumps(_without_infinities(content), indent=2, allow_nan=False, default=os.fspath)


def write_json(content: Any, path: Path | str) -> None:
    """Write the JSON of :func:`json_text` to an automatically named file, see :func:`replacing`."""
    with replacing(path, named=False) as part:
        part.write_text(json_text(content) + "\n", encoding="utf-8")


def _without_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_infinities(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_infinities(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows with the same columns to a CSV file, automatically named, see :func:`replacing`.

    Text that spreadsheets would run as a formula, which can send the content of other cells (OWASP,
    CSV injection), gets a leading apostrophe, because file names are untrusted.
    """
    formula = tuple("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")
    with (
        replacing(path, named=False) as part,
        part.open("w", encoding="utf-8", newline="") as stream,
    ):
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        for row in rows:
            texts = {
                name
                for name, value in row.items()
                if isinstance(value, str) and value.startswith(formula)
            }
            writer.writerow(
                {name: f"'{value}" if name in texts else value for name, value in row.items()}
            )


def write_tensors(
    path: Path | str, tensors: Mapping[str, Tensor], header: dict[str, str], named: bool = True
) -> None:
    """Write tensors of any device and a metadata header to a safetensors file, as
    :func:`replacing` does."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with replacing(path, named=named) as part:
        try:
            save_file(contiguous, part, metadata=header)
        except SafetensorError as error:  # for example if the disk is full
            raise OSError(one_line(error)) from error
