"""Writes 3DGS PLY files; :mod:`~pointsplat_ns.io.ply` reads them and says what they hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pointsplat_ns.gaussians import PLAIN, Gaussians, Traits
from pointsplat_ns.io.files import replacing
from pointsplat_ns.io.ply_dialects import COLUMNS
from pointsplat_ns.io.ply_header import first_lines
from pointsplat_ns.io.usable import keep_usable
from pointsplat_ns.system.pieces import CHUNK


def write_ply(scene: Gaussians, path: Path | str) -> None:
    """Write ``scene`` as a 3DGS PLY: binary little endian, float32, the reference's property order.

    :func:`read_ply` reads a float32 scene back unchanged to the bit. Gaussians that cannot be drawn (NaN, or Inf
    where it is not valid) are left out, and their number is logged. The write is atomic.

    Raises:
        SceneError: if ``path`` cannot be written.
    """
    scene = keep_usable(scene.detach().to("cpu", torch.float32), path)
    about = len(scene), scene.sh_degree, scene.traits
    with replacing(path, ply_bytes(*about)) as part, part.open("wb") as stream:
        stream.write(header_bytes(*about))
        for first in range(0, len(scene), CHUNK):
            stream.write(row_table(scene[first : first + CHUNK]).data)


def row_table(scene: Gaussians) -> np.ndarray:
    """The rows of a 3DGS PLY, (N, 17 + 3 K) little-endian float32, of a float32 scene on the CPU."""
    rest = scene.features_rest.transpose(1, 2).reshape(len(scene), 3 * scene.features_rest.shape[1])
    values = [scene.means, torch.zeros_like(scene.means), scene.features_dc, rest]
    values += [scene.opacities, scene.scales, scene.quats]
    return np.ascontiguousarray(torch.cat(values, dim=1).numpy().astype("<f4", copy=False))


def header_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> bytes:
    """The header of a 3DGS PLY of ``count`` Gaussians, whose :func:`row_table` follows."""
    names = column_names(3 * ((sh_degree + 1) ** 2 - 1))
    lines = [*first_lines(traits), f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""]).encode("ascii")


def ply_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
    """Size of the 3DGS PLY of ``count`` Gaussians, bytes: an ASCII header, then 17 numbers a Gaussian (normals
    included) and three for each SH coefficient beyond the constant one, as float32."""
    return len(header_bytes(count, sh_degree, traits)) + 4 * (17 + 3 * ((sh_degree + 1) ** 2 - 1)) * count


def column_names(rest: int) -> list[str]:
    """All vertex properties in the order of files, with so many of SH beyond the constant one."""
    first = [*COLUMNS["means"], *COLUMNS["normals"], *COLUMNS["features_dc"]]
    last = [*COLUMNS["opacities"], *COLUMNS["scales"], *COLUMNS["quats"]]
    return [*first, *(f"f_rest_{i}" for i in range(rest)), *last]
