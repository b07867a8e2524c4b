"""Attributes of SPZ files as bytes: quantisation of positions, sizes, colours, quaternions and SH.

Source: README.md of the format's library, github.com/nianticlabs/spz.
"""

from __future__ import annotations

import numpy as np

from pointsplat_ns.scene.formats import coding
from pointsplat_ns.scene.formats.capacity import Span
from pointsplat_ns.scene.formats.coding import Array
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE, Gaussians

SIZES = Span(-10.0, -10.0 + 255 / 16, 1 / 16)
"""Log-scales."""

COLOUR_SCALE = 0.15
"""Factor of the constant SH coefficient; 0 is stored as one half."""

_XYZW = np.array([1, 2, 3, 0])  # SPZ has w last


def decoded(
    parts: list[Array], rest: int, fraction_bits: int, opacity_factor: int = 1
) -> Gaussians:
    """The scene of N Gaussians of decompressed attributes.

    Args:
        parts: bytes of positions (9 N), opacities (N), colours (3 N), sizes (3 N), quaternions
            (3 N in version 2, else 4 N) and SH coefficients (3 K N), in this order.
        rest: K, the number of SH coefficients per channel beyond the constant one.
        fraction_bits: number of bits of a position after the point.
        opacity_factor: factor of opacities. The result is at most 1.
    """
    positions, opacities, colours, sizes, quats, sh = parts
    n = len(opacities)
    known = sh.reshape(n, rest, 3)[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]
    levels = np.minimum(opacities.astype(np.uint16) * opacity_factor, 255)
    return coding.scene_of(
        _from_fixed_point(positions.reshape(n, 3, 3), fraction_bits),
        sizes.reshape(n, 3).astype(np.float32) * np.float32(SIZES.step) + np.float32(SIZES.low),
        _from_three_bytes(quats) if len(quats) == 3 * n else _from_four_bytes(quats),
        coding.logits_of_bytes(levels),
        (colours.reshape(n, 3).astype(np.float32) / 255 - 0.5) / COLOUR_SCALE,
        (known.astype(np.float32) - 128) / 128,
    )


def encoded(
    scene: Gaussians, fraction_bits: int, sh_bits: tuple[int, int], quat_bytes: int
) -> list[bytes]:
    """The attributes of a scene in file order.

    Args:
        scene: N Gaussians, float32 on the CPU, within range.
        fraction_bits: number of bits of a position after the point.
        sh_bits: number of bits of an SH coefficient of degree 1, and above.
        quat_bytes: 3 for version 2, else 4.
    """
    bands = scene.features_rest[:, :3], scene.features_rest[:, 3:]
    first, other = (
        _coarse(band.numpy(), count) for band, count in zip(bands, sh_bits, strict=True)
    )
    fixed = np.rint(np.ldexp(scene.means.double().numpy(), fraction_bits)).astype("<i4")
    colours = (scene.features_dc.double().numpy() * COLOUR_SCALE + 0.5) * 255
    pack = _in_three_bytes if quat_bytes == 3 else _in_four_bytes
    return [
        np.ascontiguousarray(fixed[..., None]).view(np.uint8)[..., :3].tobytes(),
        coding.bytes_of_logits(scene).tobytes(),
        coding.to_bytes(colours).tobytes(),
        coding.to_bytes((scene.scales.double() - SIZES.low) / SIZES.step).tobytes(),
        pack(coding.unit_quats(scene)).tobytes(),
        np.concatenate([first, other], axis=1).tobytes(),
    ]


def _coarse(coefficients: Array, bits: int) -> Array:
    """SH coefficients as bytes of which only the upper ``bits`` differ; 0 stays 0."""
    step = 1 << (8 - bits)
    levels = np.rint(coefficients.astype(np.float64) * 128 / step) * step + 128
    return np.clip(levels, 0, 255).astype(np.uint8)


def _from_fixed_point(parts: Array, bits: int) -> Array:
    """Positions (N, 3) from three bytes each, (N, 3, 3), lowest byte first."""
    low, middle, high = (parts[..., i].astype(np.int32) for i in range(3))
    signed = (low | middle << 8 | high << 16) << 8 >> 8  # sign extension
    return np.ldexp(signed.astype(np.float32), -bits)


def _in_three_bytes(unit: Array) -> Array:
    """Version 2: x, y and z in a byte each, (N, 3), of unit quaternions (N, 4) wxyz. The sign is
    that of a positive w."""
    signed = unit * np.where(unit[:, :1] < 0, -1.0, 1.0)
    return coding.to_bytes(signed[:, 1:] * 127.5 + 127.5)


def _from_three_bytes(packed: Array) -> Array:
    """Version 2: x, y and z in a byte each; w is positive."""
    xyz = packed.reshape(-1, 3).astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.clip(1 - np.square(xyz).sum(axis=1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], axis=1)


def _in_four_bytes(unit: Array) -> Array:
    """From version 3: index of the largest component; nine bits and a sign for the others."""
    largest, others = coding.smallest_three(unit[:, _XYZW])
    magnitudes = (
        np.rint(np.abs(others) * 2**0.5 * 511).astype(np.uint32)
        | (others < 0).astype(np.uint32) << 9
    )
    words = (
        largest.astype(np.uint32) << 30
        | magnitudes[:, 0] << 20
        | magnitudes[:, 1] << 10
        | magnitudes[:, 2]
    )
    return words.astype("<u4")


def _from_four_bytes(packed: Array) -> Array:
    """Quaternions (N, 4) wxyz of :func:`_in_four_bytes`."""
    words = packed.view("<u4")
    levels = (
        np.stack([words >> shift & 511 for shift in (20, 10, 0)], axis=1).astype(np.float32) / 511
    )
    negative = np.stack([words >> shift & 512 for shift in (20, 10, 0)], axis=1) > 0
    others = np.where(negative, -levels, levels) * 0.5**0.5
    quats = np.empty((len(words), 4), np.float32)
    quats[:, _XYZW] = coding.from_smallest_three((words >> 30).astype(np.int64), others)
    return quats
