"""Shared by the formats: quantisation of attributes, and reading of untrusted bytes."""

from __future__ import annotations

import lzma
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import interleave, spread_bits, zero_as_identity
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.files import one_line, require_memory
from pointsplat_ns.system.opening import open_regular
from pointsplat_ns.system.tensors import INDICES

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])

Array = NDArray[Any]


@contextmanager
def damage_named(path: Path, kind: str) -> Iterator[None]:
    """Turn decoder errors into a :class:`SceneError` that names the file and its kind, such as
    "SPZ"."""
    of_decoders = (
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        OverflowError,
        RecursionError,
        SyntaxError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        struct.error,
        zlib.error,
        lzma.LZMAError,
        zipfile.BadZipFile,
    )
    try:
        # No numpy warnings for bits that mean NaN or Inf: these Gaussians are dropped and counted
        # later.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            yield
    except SceneError:
        raise
    except OSError as error:
        why = error.strerror or one_line(error)
        raise SceneError(f"{path}: cannot be read as {kind} ({why})") from error
    except of_decoders as error:
        why = f"lacks {error}" if isinstance(error, KeyError) else one_line(error)
        raise SceneError(f"{path}: damaged {kind} file ({why})") from error


def load_bytes(path: Path) -> bytes:
    """The whole content of a regular file; a SceneError if it does not fit into memory."""
    with open_regular(path) as stream:
        require_memory(path, os.fstat(stream.fileno()).st_size)
        return stream.read()


def file_beside(path: Path, name: Any) -> Path:
    """The file that ``path`` names relative to its folder. Raises SceneError unless it is there or
    in a folder below."""
    place = PurePosixPath(name) if isinstance(name, str) else PurePosixPath()
    bad = ".." in place.parts or place.is_absolute() or set("\\:\0") & set(str(name))
    if bad or not place.parts:
        raise SceneError(
            f"{path}: names the file {str(name)[:80]!r}; expected one in its own folder"
        )
    return path.parent.joinpath(*place.parts)


def require_plausible(path: Path, unpacked: int, packed: int, count: int, rest: int) -> None:
    """Check the header of a compressed file before memory is allocated. Raises SceneError if it
    declares more bytes than ``packed`` bytes can hold, or more Gaussians (with ``rest`` SH
    coefficients per channel beyond the constant one) than fit into memory."""
    # A compressed byte holds at most 100 bytes: 216,000 Gaussians that differ only in their place
    # on a grid reach 27, trained scenes less than 4. A file of any size may hold 4 MB: 200,000
    # equal Gaussians.
    if unpacked > max(1 << 22, 100 * packed):
        raise SceneError(
            f"{path}: the header declares {count} Gaussians of {unpacked} bytes in all, more than "
            f"{packed} compressed bytes can hold"
        )
    require_memory(path, unpacked + 4 * count * (14 + 3 * rest))


class Blocks:
    """Consecutive arrays in the bytes of a file, from offset ``start``."""

    def __init__(self, data: bytes | memoryview, path: Path, start: int = 0):
        self._data = data
        self._path = path
        self._position = start

    def take(self, dtype: str | np.dtype, *shape: int) -> NDArray:
        """The next array, without a copy; a SceneError if the data ends too early."""
        count = math.prod(int(side) for side in shape)
        left = len(self._data) - self._position
        size = count * np.dtype(dtype).itemsize
        if size > left:
            raise SceneError(
                f"{self._path}: truncated; {size} bytes expected at byte {self._position}, found "
                f"{left}"
            )
        array = np.frombuffer(self._data, dtype, count, self._position).reshape(shape)
        self._position += size
        return array


def scene_of(
    means: ArrayLike,
    scales: ArrayLike,
    quats: ArrayLike,
    opacities: ArrayLike,
    dc: ArrayLike,
    rest: ArrayLike,
) -> Gaussians:
    """A float32 scene from decoded arrays: means (N, 3), log-scales (N, 3), quaternions (N, 4)
    wxyz, opacity logits (N,), and SH coefficients (N, 3) and (N, K, 3)."""
    columns = (means, scales, quats, np.reshape(opacities, (-1, 1)), dc, rest)
    return Gaussians(
        *(torch.from_numpy(np.array(column, np.float32, order="C")) for column in columns)
    )


def joined(parts: Sequence[Gaussians], degree: int | None = None) -> Gaussians:
    """All Gaussians of several scenes, in order, with SH up to ``degree``, by default the highest
    of the scenes. Missing bands are zero."""
    if degree is None:
        degree = max((part.sh_degree for part in parts), default=0)
    filled = [Gaussians.empty(degree)]
    for part in parts:
        rest = part.features_rest.new_zeros(len(part), (degree + 1) ** 2 - 1, 3)
        known = min(rest.shape[1], part.features_rest.shape[1])
        rest[:, :known] = part.features_rest[:, :known]
        filled.append(part.replace(features_rest=rest))
    return Gaussians.cat(filled)


def logits_of_bytes(levels: Array) -> Array:
    """Finite opacity logits of bytes. Bytes 0 and 255 are decoded as 0.25 and 254.75, the middle of
    the values rounded to them, because some programs drop infinite logits."""
    share = np.clip(levels.astype(np.float64), 0.25, 254.75) / 255
    return np.log(share / (1 - share)).astype(np.float32)


def logits_of_shares(alphas: Array) -> Array:
    """Finite opacity logits of opacities from 0 to 1, float64. Opacities that float32 rounds to 1
    are decoded as the middle of the values rounded to it."""
    share = np.clip(alphas, 1e-13, 1 - 2.0**-25)
    return np.log(share / (1 - share)).astype(np.float32)


def bytes_of_logits(scene: Gaussians) -> Array:
    """Opacities (N,) as bytes, rounded."""
    return to_bytes(255 * scene.alphas.double())


def shares_of_dc(scene: Gaussians) -> Array:
    """Colours (N, 3) of the constant SH coefficients, float64; may be outside of [0, 1]."""
    return 0.5 + SH_C0 * scene.features_dc.double().numpy()


def to_bytes(values: Array | Tensor) -> Array:
    """Values rounded to the nearest byte."""
    return np.clip(np.rint(np.asarray(values)), 0, 255).astype(np.uint8)


def unit_quats(scene: Gaussians) -> Array:
    """Unit quaternions (N, 4) wxyz, float64; zero becomes the identity."""
    quats = zero_as_identity(scene.quats).double()
    return (quats / quats.norm(dim=1, keepdim=True)).numpy()


def smallest_three(unit: Array) -> tuple[Array, Array]:
    """Smallest-three encoding of unit quaternions (N, 4): the index (N,) of the largest component,
    whose sign is made positive, and the others in order, (N, 3), within +-1/sqrt(2)."""
    largest = np.abs(unit).argmax(axis=1)
    rows = np.arange(len(unit))
    signed = unit * np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    return largest, np.take_along_axis(signed, _OTHERS[largest], axis=1)


def from_smallest_three(largest: Array, others: Array) -> Array:
    """Quaternions (N, 4) from the result of :func:`smallest_three`. If the other components are too
    long, the largest is 0."""
    quats = np.empty((len(others), 4), np.float32)
    np.put_along_axis(quats, _OTHERS[largest], others.astype(np.float32), axis=1)
    left = np.clip(1.0 - np.square(others.astype(np.float64)).sum(axis=1), 0.0, None)
    quats[np.arange(len(others)), largest] = np.sqrt(left)
    return quats


def morton_order(scene: Gaussians) -> Tensor:
    """Indices (N,) along a Morton curve, which puts neighbours in space together."""
    if len(scene) == 0:
        return torch.zeros(0, **INDICES)
    low, high = scene.means.double().aminmax(dim=0)
    cells = ((scene.means.double() - low) / (high - low).clamp_min(1e-300) * 0x1FFFFF).long()
    return interleave(*(spread_bits(axis) for axis in cells.unbind(1))).argsort(stable=True)
