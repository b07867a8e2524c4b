"""Writes RAD, the format of Spark: a tree of Gaussians in pages of 65,536, loaded on demand.

A file is a description in JSON, followed by the pages. A page is a description and one array per
attribute, component by component, deflated. The root is the first Gaussian; the children of a
Gaussian are consecutive.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.scene.formats.coding import Array, shares_of_dc, to_bytes, unit_quats
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.offsets import offset_text
from pointsplat_ns.system.progress import Progress, silent

MOST_CHILDREN = 65535

_PAGE = 65536


def encode_rad(
    scene: Gaussians, children: Tensor, starts: Tensor, progress: Progress = silent
) -> bytes:
    """Encode a tree of Gaussians as a RAD file.

    Args:
        scene: the N Gaussians of all levels, float32 on the CPU.
        children: (N,) number of children of each Gaussian, at most :data:`MOST_CHILDREN`.
        starts: (N,) index of the first child.
        progress: called during compression.
    """
    n = len(scene)
    degree = scene.sh_degree
    encoding = _ranges(scene)
    pages: list[bytes] = []
    places: list[dict[str, int]] = []
    offset = 0
    for first in range(0, n, _PAGE):
        progress("compressing", first / n)
        rows = slice(first, first + _PAGE)
        payload: list[bytes] = []
        properties: list[dict[str, Any]] = []
        size = 0
        for (name, kind, bounds), array in _attributes(
            scene[rows], encoding, children[rows], starts[rows]
        ):
            packer = zlib.compressobj(6, zlib.DEFLATED, -15)  # 9 takes three times as long for 1 %
            packed = packer.compress(array.tobytes()) + packer.flush()
            about = {
                "offset": size,
                "bytes": len(packed),
                "property": name,
                "encoding": kind,
                "compression": "gz",
            }
            properties.append({**about, **bounds})
            payload.append(_padded(packed))
            size += len(payload[-1])
        page: dict[str, Any] = {
            "version": 1,
            "base": first,
            "count": len(children[rows]),
            "payloadBytes": size,
        }
        page.update(maxSh=degree, lodTree=True, splatEncoding=encoding, properties=properties)
        pages.append(b"".join([_described(b"RADC", page), struct.pack("<Q", size), *payload]))
        places.append({"offset": offset, "bytes": len(pages[-1])})
        offset += len(pages[-1])
    head: dict[str, Any] = {
        "version": 1,
        "type": "gsplat",
        "count": n,
        "maxSh": degree,
        "lodTree": True,
    }
    head.update(chunkSize=_PAGE, allChunkBytes=offset, chunks=places, splatEncoding=encoding)
    if scene.offset is not None:
        head["comment"] = f"Offset: {offset_text(scene.offset)}"
    return b"".join([_described(b"RAD0", head), *pages])


def _described(magic: bytes, content: dict[str, Any]) -> bytes:
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    return magic + struct.pack("<I", len(text)) + _padded(text)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def _ranges(scene: Gaussians) -> dict[str, Any]:
    """Ranges of bytes: of colours, of SH by degree, and of the sizes that viewers support."""
    colours = np.quantile(shares_of_dc(scene), [0.001, 0.999])
    finite = scene.scales[scene.scales.isfinite()].double().numpy()  # excludes flat axes
    sizes = np.quantile(finite, [0.001, 1.0]) if len(finite) else np.zeros(2)
    limits = {f"sh{degree}Max": 1.0 for degree in (1, 2, 3)}
    for degree in range(1, scene.sh_degree + 1):
        limits[f"sh{degree}Max"] = max(float(_band(scene, degree).abs().max()), 1e-3)
    return {
        "rgbMin": min(float(colours[0]), 0.0),
        "rgbMax": max(float(colours[1]), 1.0),
        "lnScaleMin": float(sizes[0]) - 0.5,
        "lnScaleMax": float(sizes[1]) + 0.5,
        **limits,
        "lodOpacity": True,
    }


def _band(scene: Gaussians, degree: int) -> Tensor:
    """SH coefficients (N, 3 * (2 d + 1)) of degree d, the three channels of each together."""
    return scene.features_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1].reshape(len(scene), -1)


def _attributes(
    scene: Gaussians, encoding: dict[str, Any], children: Tensor, starts: Tensor
) -> Iterator[tuple[tuple[str, str, dict[str, float]], Array]]:
    """Attributes of a page: name, encoding with range, and array, component by component."""
    low = encoding["rgbMin"]
    high = encoding["rgbMax"]
    bytes_of_means = (
        np.ascontiguousarray(scene.means.numpy().T.astype("<f4")).view(np.uint8).reshape(3, -1, 4)
    )
    yield ("center", "f32_lebytes", {}), np.ascontiguousarray(bytes_of_means.transpose(2, 0, 1))
    yield ("alpha", "f16", {}), scene.alphas.numpy().astype("<f2")
    colours = to_bytes(255 * (shares_of_dc(scene) - low) / (high - low))
    yield ("rgb", "r8", {"min": low, "max": high}), colours.T
    yield ("scales", "ln_f16", {}), scene.scales.clamp_min(-6e4).numpy().T.astype("<f2")
    yield ("orientation", "oct88r8", {}), _turns(unit_quats(scene))
    for degree in range(1, scene.sh_degree + 1):
        most = encoding[f"sh{degree}Max"]
        levels = (_band(scene, degree).double() * (127 / most)).round().clamp(-127, 127)
        yield (f"sh{degree}", "s8", {"min": -most, "max": most}), levels.to(torch.int8).numpy().T
    yield ("child_count", "u16", {}), children.numpy().astype("<u2")
    yield ("child_start", "u32", {}), starts.numpy().astype("<u4")


def _turns(quats: Array) -> Array:
    """Rotations (N, 4) wxyz as (N, 3) bytes: the axis in octahedral encoding, and the angle."""
    positive = np.where(quats[:, :1] < 0, -quats, quats)
    axes = positive[:, 1:]
    length = np.linalg.norm(positive[:, 1:], axis=1)
    axes = np.where(length[:, None] > 1e-6, axes, [1.0, 0.0, 0.0])
    x, y, z = (axes / np.abs(axes).sum(axis=1, keepdims=True)).T
    sign_x = np.where(x < 0, -1.0, 1.0)
    sign_y = np.where(y < 0, -1.0, 1.0)
    folded = [
        np.where(z < 0, (1 - np.abs(y)) * sign_x, x),
        np.where(z < 0, (1 - np.abs(x)) * sign_y, y),
    ]
    angle = 2 * np.arctan2(length, positive[:, 0]) / np.pi
    return to_bytes(255 * np.stack([0.5 * (folded[0] + 1), 0.5 * (folded[1] + 1), angle], axis=1))
