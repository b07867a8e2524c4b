"""SOG files: PlayCanvas' WebP images, in a zip archive (``.sog``) or a folder with ``meta.json``.

A Gaussian is a pixel of each image. Positions are 16-bit logarithms. Log-scales and colours are
entries of a codebook of 256 numbers. Quaternions lack their largest component. SH are rows of a
palette of up to 65,536.
"""

from __future__ import annotations

import functools
import io
import json
import math
import zipfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats import coding
from pointsplat_ns.scene.formats.capacity import Capacity, Span
from pointsplat_ns.scene.formats.coding import Array
from pointsplat_ns.scene.formats.palette import LEVELS, codebook, palette
from pointsplat_ns.scene.formats.rounding import (
    ROUNDING,
    multiples,
    rounded_shapes,
    steps_of,
    weights,
)
from pointsplat_ns.scene.formats.sog_images import SOG_META, Images, webp
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.system.progress import Progress, silent

MAX_SIDE = 16_383
"""Maximum width and height of a WebP image, pixels."""

_LEVELS = 65_535  # steps of positions
_ACROSS = 64  # palette entries per row of pixels


def read_sog(path: Path | str) -> Gaussians:
    """Read a ``.sog`` file, or a folder of its parts or its ``meta.json``, of version 2 or of
    version 1, which has no number, as :func:`~pointsplat_ns.scene.read_scene` does. Raises
    SceneError if a part is missing or damaged, or declares more than it can hold."""
    path = Path(path)
    with coding.damage_named(path, "SOG"), closing(Images(path)) as images:
        return _decode(images, images.meta(), path)


def encode_sog(scene: Gaussians, progress: Progress = silent) -> bytes:
    """Encode a scene, float32 on the CPU, as a ``.sog`` file. Gaussians are reordered, so that
    neighbours in the images are neighbours in space. Raises SceneError if there are more Gaussians
    than the images can hold."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, data in sog_parts(scene, progress).items():
            # The same scene gives the same bytes at any time.
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
    return stream.getvalue()


def _decode(images: Images, meta: dict[str, Any], path: Path) -> Gaussians:
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise SceneError(f"{path}: SOG of version {version!r}; expected 1 or 2")
    n = meta["count"] if version == 2 else meta["means"]["shape"][0]
    if not isinstance(n, int) or not 0 <= n <= MAX_SIDE**2:
        raise SceneError(f"{path}: declares {n!r} Gaussians; expected a number up to {MAX_SIDE**2}")
    # the four images of every scene
    coding.require_plausible(path, 16 * n, images.size, n, _rest_of(meta))
    pixels = functools.partial(_pixels, images, n)
    low = pixels(meta["means"], 0)
    high = pixels(meta["means"], 1)
    mins, maxs = (_numbers(meta["means"][name], 3) for name in ("mins", "maxs"))
    logs = mins + (maxs - mins) * (low[:, :3].astype(np.float64) + 256.0 * high[:, :3]) / _LEVELS
    quats = pixels(meta["quats"])
    colors = pixels(meta["sh0"])
    # alpha is this value plus the index of the largest component
    tops = quats[:, 3].astype(np.int64) - 252
    rotations = coding.from_smallest_three(
        tops.clip(0), (quats[:, :3].astype(np.float64) / 255 - 0.5) * 2**0.5
    )
    rotations[tops < 0] = (1, 0, 0, 0)  # as this format's viewers do
    dc = _looked_up(meta["sh0"], colors, 3 if version == 2 else 4)
    return coding.scene_of(
        _of_logs(logs),
        _looked_up(meta["scales"], pixels(meta["scales"]), 3),
        rotations,
        coding.logits_of_bytes(colors[:, 3]) if version == 2 else dc[:, 3],
        dc[:, :3],
        _read_sh(images, n, meta),
    ).replace(antialiased=meta.get("model") == "antialiased")


def _pixels(images: Images, n: int, part: dict[str, Any], file: int = 0) -> Array:
    return images.pixels(part["files"][file], n).reshape(-1, 4)[:n]


def _sh_of(meta: dict[str, Any]) -> dict[str, Any]:
    """The SH entry of ``meta.json``; empty if the SH degree is 0."""
    part = meta.get("shN") or {}
    if not isinstance(part, dict):
        raise ValueError(f"shN is a {type(part).__name__}, expected an object")
    return part


def _rest_of(meta: dict[str, Any]) -> int:
    """SH coefficients per channel beyond the constant one; the maximum where only an image shows
    the number."""
    part = _sh_of(meta)
    bands = part.get("bands", MAX_SH_DEGREE) if part else 0
    if not isinstance(bands, int) or not 0 <= bands <= MAX_SH_DEGREE:
        raise ValueError(f"SH degree {bands!r}, expected 0 to {MAX_SH_DEGREE}")
    return (bands + 1) ** 2 - 1


def _read_sh(images: Images, n: int, meta: dict[str, Any]) -> Array:
    part = _sh_of(meta)
    if not part or part.get("bands") == 0:
        return np.empty((n, 0, 3))
    labels = _pixels(images, n, part, 1)
    index = labels[:, 0].astype(np.int64) + 256 * labels[:, 1].astype(np.int64)
    if "bands" in part:
        rest = _rest_of(meta)
        entries = _entries_of(part, index)
        colors = images.pixels(
            part["files"][0], _ACROSS * rest * -(-entries // _ACROSS), _ACROSS * rest
        )
    else:  # version 1: the width of the image decides
        colors = images.pixels(
            part["files"][0], _ACROSS * 3 * -(-(int(index.max(initial=0)) + 1) // _ACROSS)
        )
        rest, over = divmod(colors.shape[1], _ACROSS)
        if over or rest not in (3, 8, 15):
            raise ValueError(f"a palette {colors.shape[1]} pixels wide, expected 192, 512 or 960")
        entries = colors.shape[0] * _ACROSS
    table = _looked_up(part, colors.reshape(-1, 4), 3).reshape(-1, rest, 3)
    known = index < min(entries, len(table))
    return np.where(known[:, None, None], table[np.where(known, index, 0)], np.float32(0))


def _entries_of(part: dict[str, Any], index: Array) -> int:
    """Number of palette entries: ``count``, in LichtFeld's files ``palette_size``, or without
    either, as many as the labels name. Raises ValueError if it is not a number from 1 to 65536."""
    entries = part.get("count", part.get("palette_size", int(index.max(initial=0)) + 1))
    if not isinstance(entries, int) or not 0 < entries <= 65536:
        raise ValueError(f"a palette of {entries!r} entries, expected 1 to 65536")
    return entries


def _looked_up(part: dict[str, Any], pixels: Array, channels: int) -> Array:
    """Values (N, channels) float32: codebook entries, or in version 1 shares between bounds."""
    book = part.get("codebook")
    if book is None:
        low, high = (np.broadcast_to(_numbers(part[name]), channels) for name in ("mins", "maxs"))
        table = low + (high - low) * np.linspace(0, 1, LEVELS)[:, None]
    else:
        entries = _numbers([0 if entry is None else entry for entry in book])
        if not 0 < len(entries) <= LEVELS:
            raise ValueError(f"a codebook of {len(entries)} entries, expected {LEVELS}")
        table = np.broadcast_to(
            np.pad(entries, (0, LEVELS - len(entries)))[:, None], (LEVELS, channels)
        )
    table = table.astype(np.float32)
    return np.stack([table[pixels[:, i], i] for i in range(channels)], axis=1)


def _numbers(values: Any, count: int | None = None) -> Array:
    """Numbers in a JSON file."""
    array = np.asarray(values, np.float64)
    if count is not None and array.shape != (count,):
        raise ValueError(f"{array.size} numbers, expected {count}")
    return array


def sog_parts(scene: Gaussians, progress: Progress, ordered: bool = False) -> dict[str, bytes]:
    """The files of a SOG folder by name, for a scene, float32 on the CPU. Gaussians are reordered
    unless ``ordered``: neighbours in space are already consecutive. Raises SceneError as
    :func:`encode_sog`."""
    n = len(scene)
    width = max(4 * math.ceil(math.sqrt(n) / 4), 4)
    height = max(4 * math.ceil(n / width / 4), 4)
    if max(width, height) > MAX_SIDE:
        raise SceneError(f"{n} Gaussians; a SOG file holds at most {MAX_SIDE**2}")
    progress("packing attributes", 0.0)
    scene = scene if ordered else scene[coding.morton_order(scene)]
    images: dict[str, tuple[Array, int, int]] = {}

    def add(name: str, columns: Sequence[Array]) -> list[str]:
        images[name] = (np.column_stack(columns).astype(np.uint8), width, height)
        return [name]

    levels, mins, maxs, _ = _levels_of(scene)
    steps = np.rint(levels).astype(np.int64)
    scales, scale_index = codebook(scene.scales.clamp_min(CAPACITY.sizes.low))  # -Inf of flat axes
    colors, color_index = codebook(scene.features_dc)
    largest, others = coding.smallest_three(coding.unit_quats(scene))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "pointsplat-ns"},
        "count": n,
        "means": {
            "mins": mins.tolist(),
            "maxs": maxs.tolist(),
            "files": add("means_l.webp", [steps & 255]) + add("means_u.webp", [steps >> 8]),
        },
        "scales": {"codebook": _short(scales), "files": add("scales.webp", [scale_index.numpy()])},
        "quats": {
            "files": add(
                "quats.webp", [coding.to_bytes((others / 2**0.5 + 0.5) * 255), 252 + largest]
            )
        },
        "sh0": {
            "codebook": _short(colors),
            "files": add("sh0.webp", [color_index.numpy(), coding.bytes_of_logits(scene)]),
        },
    }
    if scene.antialiased:
        meta["model"] = "antialiased"
    if scene.sh_degree:
        meta["shN"] = _pack_sh(scene, images, (width, height), progress)
    files = {}
    for done, (name, image) in enumerate(images.items()):
        progress("compressing", done / len(images))
        files[name] = webp(*image)
    return {SOG_META: json.dumps(meta).encode(), **files}


def _short(book: Tensor) -> list[float]:
    """An ascending codebook, float32, with just enough digits to keep its numbers distinct. Copies
    of the last are zeros, because no index uses them."""
    last = int((book < book[-1]).sum())
    return [float(f"{value:.9g}") for value in book[: last + 1].tolist()] + [0] * (
        len(book) - last - 1
    )


def _of_logs(logs: Array) -> Array:
    """Positions from their logarithms."""
    return np.sign(logs) * np.expm1(np.abs(logs))


def _levels_of(scene: Gaussians) -> tuple[Array, Array, Array, Tensor]:
    """Positions as logarithms, (N, 3) float64 from 0 to 65,535; the logarithms at these two bounds,
    (3,) each; and the local position steps, (N, 3) float64, world units."""
    means = scene.means.double().numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    mins, maxs = (logs.min(axis=0), logs.max(axis=0)) if len(means) else (np.zeros(3), np.zeros(3))
    levels = (logs - mins) / np.where(maxs > mins, maxs - mins, 1.0) * _LEVELS
    return (
        levels,
        mins,
        maxs,
        torch.from_numpy((maxs - mins) / _LEVELS) * (1 + scene.means.double().abs()),
    )


CAPACITY = Capacity(
    sizes=Span(-30.0), position_steps=lambda scene: _levels_of(scene)[3].amax(dim=1)
)


def rounded_for_sog(scene: Gaussians, tolerance: float) -> Gaussians:
    """A scene that takes fewer bytes as SOG: its numbers are rounded
    (:mod:`~pointsplat_ns.scene.formats.rounding`), and its SH above degree 0 become palette
    entries. A tolerance of 0 changes nothing."""
    if not tolerance or not len(scene):
        return scene
    steps = steps_of(scene, tolerance)
    levels, mins, maxs, of_level = _levels_of(scene)
    coarse = multiples(
        torch.from_numpy(levels), (steps.means / of_level.clamp_min(1e-300)).clamp_min(1)
    ).numpy()
    outermost = (levels <= 0) | (levels >= _LEVELS)  # fixed, because they define the levels
    logs = mins + (maxs - mins) * np.where(outermost, levels, coarse.clip(0, _LEVELS)) / _LEVELS
    means = torch.from_numpy(_of_logs(logs)).float()
    rest = _few_sh(scene, tolerance) if scene.sh_degree else scene.features_rest
    return rounded_shapes(scene, steps).replace(means=means, features_rest=rest)


def _few_sh(scene: Gaussians, tolerance: float) -> Tensor:
    """SH above degree 0, (N, K, 3), as entries of the smallest palette with a sufficiently small
    colour error, at most one entry per two Gaussians. Its numbers are multiples of their error."""
    rows = scene.features_rest.flatten(1)
    each = weights(scene)
    wanted = ROUNDING.palette_error * tolerance / (SH_C0 * scene.features_rest.shape[1] ** 0.5)
    most = min(len(scene) // 2, 65_536)

    def made(share: float) -> tuple[Tensor, Tensor, float]:
        """A palette of a given size, each Gaussian's entry, and the error of a coefficient."""
        book, index = palette(rows, 64 * max(int(share / 64), 1), each, lambda done: None)
        return (
            book,
            index,
            float((each @ (book[index] - rows).double().square().mean(dim=1) / each.sum()).sqrt()),
        )

    size = len(scene) / ROUNDING.most_rows
    book, index, error = made(size)
    while error > wanted and 2 * size <= most:
        before = error
        size = 2 * size
        book, index, error = made(size)
        if error < wanted:
            least = max(error, 1e-3 * wanted)  # if the error is zero
            book, index, error = made(size * (wanted / least) ** (-1 / math.log2(before / least)))
    numbers, number = codebook((book / error).round() * error if error > 0 else book)
    return numbers[number.long()][index].reshape(scene.features_rest.shape)


def _pack_sh(
    scene: Gaussians,
    images: dict[str, tuple[Array, int, int]],
    size: tuple[int, int],
    progress: Progress,
) -> dict[str, Any]:
    """Add the palette and its indices to ``images``; returns their entry in ``meta.json``."""
    rest = scene.features_rest.shape[1]
    report = functools.partial(progress, "building the SH palette")
    # a power of two; an index has 16 bits
    entries = max(1024, 1 << min(len(scene), 65_536).bit_length() >> 1)
    rows, index = palette(scene.features_rest.flatten(1), entries, weights(scene), report)
    levels, level_index = codebook(rows)
    labels = np.column_stack([index.numpy() & 255, index.numpy() >> 8, np.zeros(len(index))])
    images["shN_centroids.webp"] = (
        level_index.reshape(-1, 3).numpy(),
        _ACROSS * rest,
        len(rows) // _ACROSS,
    )
    images["shN_labels.webp"] = (labels.astype(np.uint8), *size)
    return {
        "count": len(rows),
        "bands": scene.sh_degree,
        "codebook": _short(levels),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
