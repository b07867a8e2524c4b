"""3DGS PLYs as other programs write them: 2D Gaussians, and 3D filters.

Mip-Splatting keeps the size of its 3D filter beside the sizes that it was trained with; the filter belongs to the
scene, and its own ``create_fused_ply.py`` fuses both.
"""

from __future__ import annotations

from collections.abc import Container

import numpy as np
from numpy.typing import NDArray

Table = NDArray[np.float32]

COLUMNS = {
    "means": ["x", "y", "z"],
    "normals": ["nx", "ny", "nz"],
    "features_dc": ["f_dc_0", "f_dc_1", "f_dc_2"],
    "opacities": ["opacity"],
    "scales": ["scale_0", "scale_1", "scale_2"],
    "quats": ["rot_0", "rot_1", "rot_2", "rot_3"],
}
"""Vertex properties of the attributes; normals are written as zeros and not read."""

FILTER = "filter_3D"


def is_flat(names: Container[str]) -> bool:
    """Whether vertex properties are those of 2D Gaussians, whose third axis is their normal and has no size."""
    return "scale_2" not in names and all(name in names for name in ("scale_0", "scale_1", "opacity"))


def columns_of(names: Container[str]) -> dict[str, list[str]]:
    """The vertex properties to read for each attribute but ``features_rest``, and for the 3D filter."""
    return {
        **{name: COLUMNS[name] for name in ("means", "quats", "opacities", "features_dc")},
        "scales": COLUMNS["scales"][: 2 if is_flat(names) else 3],
        FILTER: [FILTER] if FILTER in names else [],
    }


def attributes_of(tables: dict[str, Table], names: Container[str]) -> dict[str, Table]:
    """The attributes of a scene, float32, of what :func:`columns_of` named, float32."""
    found = {name: table for name, table in tables.items() if name != FILTER}
    if FILTER in names:
        found["scales"], found["opacities"] = fuse_filter(found["scales"], found["opacities"], tables[FILTER])
    if is_flat(names):
        found["scales"] = np.column_stack([found["scales"], np.full(len(found["scales"]), -np.inf, np.float32)])
    return found


def fuse_filter(scales: Table, opacities: Table, sizes: Table) -> tuple[Table, Table]:
    """Sizes and opacities with Mip-Splatting's 3D filter in them.

    A standard deviation s becomes sqrt(s^2 + f^2), and an opacity is multiplied by the product of s / sqrt(s^2 + f^2)
    over the axes, the ratio of the square roots of determinants. Source: "Mip-Splatting: Alias-free 3D Gaussian
    Splatting", Yu et al. 2024, equation 9, as the authors' exporter applies it.

    Args:
        scales: (N, 3) natural logarithms of standard deviations; (N, 2) for 2D Gaussians.
        opacities: (N, 1) logits.
        sizes: (N, 1) standard deviations f of the filter, scene units; 0 changes nothing.

    Returns:
        New log-scales and logits of the same shapes.
    """
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        logs = scales.astype(np.float64)
        wide = 0.5 * np.logaddexp(2 * logs, 2 * np.log(np.abs(sizes.astype(np.float64))))
        shrunk = np.where(wide == logs, 0.0, logs - wide)  # an axis without size that stays so
        # Logarithms of the opacity and of what is left of 1: opacities of nearly 1 keep their digits.
        logits = opacities.astype(np.float64)
        log_opacity = -np.logaddexp(0.0, -logits) + shrunk.sum(axis=1, keepdims=True)
        fused = log_opacity - np.log(-np.expm1(log_opacity))
        return wide.astype(np.float32), np.where(sizes == 0, logits, fused).astype(np.float32)
