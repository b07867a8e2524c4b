"""Bounds the memory of loading a checkpoint, before torch loads it.

torch's ``weights_only`` mode runs no code of the file, but lets it call constructors with any
arguments: ``bytearray(n)`` takes n bytes. This module steps through the checkpoint's pickle opcode
by opcode without building its objects. Only the constructors that Splatfacto, gsplat's, INRIA's and
this package's trainers write are allowed, and declared sizes must fit into the file.

Source: the opcodes of :mod:`pickletools`, protocol 2, which ``torch.save`` writes.
"""

from __future__ import annotations

import io
import pickletools
import re
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from pointsplat_ns.system.opening import open_regular

MOST_PICKLED = 1 << 21
"""Maximum size of a pickle, bytes. Splatfacto's have some thousands; tensors are separate. One
byte may become an empty list of 64 bytes."""

MOST_CALLS = 100_000
"""Maximum number of tensors and other objects. Splatfacto's checkpoints have some dozens. An object
takes up to 1 kB of memory and five bytes of a pickle."""

_MAGIC = 0x1950A86A20F9469CFC6C
"""First number of a file that torch wrote before version 1.6, or with
``_use_new_zipfile_serialization=False``."""

_STORAGES = {
    "torch ByteStorage": 1,
    "torch CharStorage": 1,
    "torch BoolStorage": 1,
    "torch ShortStorage": 2,
    "torch HalfStorage": 2,
    "torch BFloat16Storage": 2,
    "torch IntStorage": 4,
    "torch FloatStorage": 4,
    "torch LongStorage": 8,
    "torch DoubleStorage": 8,
}
"""Storage types, and bytes of their numbers."""


class PickleRefused(ValueError):
    """A pickle that takes too much memory, or that no trainer writes."""


@dataclass(frozen=True)
class _Global:
    name: str  # module and name, separated by a space


@dataclass(frozen=True)
class _Storage:
    numel: int


class _Made:
    """Stand-in for a value that is not built: a container, a tensor or a result of a call."""

    def __init__(self, kind: str):
        self.kind = kind


_MARK = _Made("mark")


def need_bounded(path: Path) -> None:
    """Raise unless loading a checkpoint takes memory in proportion to its size.

    Raises:
        PickleRefused: if the pickle takes more memory, names a function that no trainer writes, or
            is not a pickle.
        OSError: if the file cannot be read.
        zipfile.BadZipFile: if the archive is damaged.
    """
    with open_regular(path) as stream:
        size = path.stat().st_size
        archived = stream.read(4) == b"PK\x03\x04"
        stream.seek(0)
        if archived:
            _Follower(io.BytesIO(_pickle_in(stream, size)), size).follow()
            return
        follower = _Follower(io.BytesIO(stream.read(MOST_PICKLED)), size)
        if follower.follow() != _MAGIC:
            raise PickleRefused("not a torch checkpoint")
        for _ in ("protocol version", "system", "content", "keys of the storages"):
            follower.follow()


def _pickle_in(stream: BinaryIO, size: int) -> bytes:
    """The pickle of torch's archive. Python and torch read archives with different code, so the
    archive must be unambiguous."""
    with zipfile.ZipFile(stream) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > size or any(
            entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size
            for entry in entries
        ):
            raise PickleRefused("a compressed archive")
        names = [entry.filename.lower() for entry in entries]
        held = [entry for entry in entries if _last(entry.filename) == "data.pkl"]
        if archive.start_dir != _directory(stream, size) or len({*names}) != len(names):
            raise PickleRefused("an ambiguous archive")
        if len(held) != 1:
            raise PickleRefused(f"an archive of {len(held)} files data.pkl")
        if held[0].file_size > MOST_PICKLED:
            raise PickleRefused(f"{held[0].file_size:,} bytes of data.pkl")
        return archive.read(held[0])


def _last(name: str) -> str:
    return name.lower().replace("\\", "/").rpartition("/")[2]


def _directory(stream: BinaryIO, size: int) -> int:
    """Offset of an archive's directory, as its end record declares it. Python's reader shifts this
    offset if bytes precede the archive."""
    stream.seek(max(0, size - 98))
    tail = stream.read(98).rjust(98, b"\0")
    place = struct.unpack_from("<I", tail, 92)[0]
    if tail[56:60] == b"PK\x06\x07" and tail[:4] == b"PK\x06\x06":  # zip64
        place = struct.unpack_from("<Q", tail, 48)[0]
    return place if tail[76:80] == b"PK\x05\x06" else -1


class _Follower:
    """Follows consecutive pickles in a stream, of a file of ``size`` bytes."""

    def __init__(self, stream: BinaryIO, size: int):
        self._stream = stream
        self._size = size
        self._stored: dict[str, int] = {}  # bytes of each storage by key
        self._total = 0  # bytes of all storages
        self._calls = 0

    def follow(self) -> Any:
        """The value of the next pickle: a number, text or stand-in. Raises PickleRefused."""
        stack: list[Any] = []
        memo: dict[Any, Any] = {}
        try:
            for opcode, argument, _ in pickletools.genops(self._stream):
                name = opcode.name
                if name == "STOP":
                    return stack.pop()
                if name in ("PUT", "BINPUT", "LONG_BINPUT"):
                    memo[argument] = stack[-1]
                elif name in ("GET", "BINGET", "LONG_BINGET"):
                    stack.append(memo[argument])
                else:
                    self._step(name, argument, stack)
        except (IndexError, KeyError) as error:
            raise PickleRefused("a damaged pickle") from error
        raise PickleRefused("a pickle without an end")

    def _step(self, name: str, argument: Any, stack: list[Any]) -> None:
        if name in _VALUES:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name]())
        elif name == "GLOBAL":
            if argument not in _CALLS and argument not in _STORAGES:
                raise PickleRefused(f"GLOBAL {argument.replace(' ', '.')}")
            stack.append(_Global(argument))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            count = int(name[-1])
            if len(stack) < count:
                raise IndexError
            stack[-count:] = [tuple(stack[-count:])]
        elif name == "TUPLE":
            stack.append(tuple(_popped(stack)))
        elif name == "APPENDS":
            _popped(stack)
            _need(stack[-1], "list")
        elif name == "APPEND":
            stack.pop()
            _need(stack[-1], "list")
        elif name == "SETITEMS":
            items = _popped(stack)
            _need_items(stack[-1], items[::2])
        elif name == "SETITEM":
            _, key = stack.pop(), stack.pop()
            _need_items(stack[-1], [key])
        elif name == "BUILD":
            _need_state(stack.pop(), stack[-1])
        elif name == "REDUCE":
            arguments, function = stack.pop(), stack.pop()
            if not isinstance(function, _Global) or not isinstance(arguments, tuple):
                raise PickleRefused("a call of a value that is not a function")
            if function.name not in _CALLS:
                raise PickleRefused(f"a call of {function.name}")
            self._calls += 1
            if self._calls > MOST_CALLS:
                raise PickleRefused(f"more than {MOST_CALLS:,} objects")
            stack.append(_CALLS[function.name](arguments))
        elif name == "BINPERSID":
            stack.append(self._storage(stack.pop()))
        elif name != "PROTO":
            raise PickleRefused(f"opcode {name}")

    def _storage(self, described: Any) -> _Storage:
        kind, type_, key, _, numel, *_ = described if isinstance(described, tuple) else (None,) * 5
        if (
            kind != "storage"
            or not isinstance(type_, _Global)
            or type_.name not in _STORAGES
            or not isinstance(key, str)
            or not isinstance(numel, int)
            or numel < 0
        ):
            raise PickleRefused("a storage that torch does not write")
        bytes_ = numel * _STORAGES[type_.name]
        before = self._stored.get(key, 0)
        self._stored[key] = max(bytes_, before)
        self._total += self._stored[key] - before
        if self._total > self._size:
            raise PickleRefused(f"a storage of {numel} numbers, more than the file can hold")
        return _Storage(numel)


def _popped(stack: list[Any]) -> list[Any]:
    """Pops the values above the last mark, and the mark."""
    last = len(stack) - 1
    while stack[last] is not _MARK:
        last -= 1
        if last < 0:
            raise IndexError
    items = stack[last + 1 :]
    del stack[last:]
    return items


def _need(value: Any, *kinds: str) -> None:
    if not isinstance(value, _Made) or value.kind not in kinds:
        raise PickleRefused("a change of an immutable value")


def _need_items(target: Any, keys: list[Any]) -> None:
    """Check that keys are numbers or text: hashing nested tuples may take any time."""
    _need(target, "dict", "ordered")
    if not all(key is None or isinstance(key, (str, int, float)) for key in keys):
        raise PickleRefused("a key that is neither a number nor text")


def _need_state(state: Any, target: Any) -> None:
    """Check a state: attributes of an ordered dictionary, or byte order of a numpy type."""
    _need(target, "ordered", "dtype")
    if target.kind == "ordered":
        _need(state, "dict")
    elif not isinstance(state, tuple) or not all(
        part is None or (isinstance(part, int) and abs(part) < 100) or part in ("<", ">", "|", "=")
        for part in state
    ):
        raise PickleRefused("a numpy type that torch does not write")


def _ordered(arguments: tuple) -> _Made:
    if len(arguments) > 1 or not all(isinstance(each, _Made) for each in arguments):
        raise PickleRefused("a dictionary built from other values than items")
    return _Made("ordered")


def _tensor(arguments: tuple) -> _Made:
    """A view of a storage. torch enlarges a storage that is too small for its view."""
    storage, offset, size, stride = arguments[:4] if len(arguments) >= 4 else (None,) * 4
    numbers = (
        (offset, *size, *stride) if isinstance(size, tuple) and isinstance(stride, tuple) else ()
    )
    if (
        not isinstance(storage, _Storage)
        or not numbers
        or len(size) != len(stride)
        or not all(type(number) is int and number >= 0 for number in numbers)
    ):
        raise PickleRefused("a tensor that torch does not write")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and last >= storage.numel:
        raise PickleRefused(f"a tensor of shape {size!s:.60}, more than its storage holds")
    return _Made("tensor")


def _parameter(arguments: tuple) -> _Made:
    _need(arguments[0], "tensor")
    return _Made("tensor")


def _dtype(arguments: tuple) -> _Made:
    name = arguments[0] if arguments else None
    if not isinstance(name, str) or re.fullmatch(r"[biufc]\d{1,2}", name) is None:
        raise PickleRefused(f"a numpy type {name!r:.40}")
    return _Made("dtype")


def _scalar(arguments: tuple) -> _Made:
    if len(arguments) != 2 or not isinstance(arguments[1], (bytes, str)):
        raise PickleRefused("a numpy number that numpy does not write")
    _need(arguments[0], "dtype")
    return _Made("number")


def _encoded(arguments: tuple) -> bytes:
    if len(arguments) != 2 or not isinstance(arguments[0], str) or arguments[1] != "latin1":
        raise PickleRefused("bytes that pickle does not write")
    return arguments[0].encode("latin1", "replace")


_CALLS: dict[str, Callable[[tuple], Any]] = {
    "collections OrderedDict": _ordered,
    "collections Counter": _ordered,
    "torch._utils _rebuild_tensor": _tensor,
    "torch._utils _rebuild_tensor_v2": _tensor,
    "torch._utils _rebuild_parameter": _parameter,
    "numpy dtype": _dtype,
    "numpy.core.multiarray scalar": _scalar,
    "numpy._core.multiarray scalar": _scalar,
    "_codecs encode": _encoded,
}
"""Allowed functions by their names in a pickle, and their stand-ins."""

_VALUES = frozenset(
    ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINSTRING")
)
"""Opcodes that push their argument."""

_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_TUPLE": tuple,
    "EMPTY_LIST": lambda: _Made("list"),
    "EMPTY_DICT": lambda: _Made("dict"),
    "MARK": lambda: _MARK,
}
"""Opcodes that push a new value."""
