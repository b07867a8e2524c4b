"""The basis of real spherical harmonics up to degree 3, and its rotation."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import DOUBLES

# Normalisation constants of the real spherical harmonics (Sloan, "Efficient Spherical Harmonic
# Evaluation", 2013), with the signs that 3DGS files use.
SH_C0 = 0.28209479177387814
"""The constant band of the real spherical harmonics, 1 / (2 sqrt(pi))."""
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def basis_rows(unit: Tensor, degree: int) -> list[Tensor]:
    """The (degree + 1)^2 basis functions, (M,) each, in unit directions (3, M)."""
    x, y, z = unit
    rows = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        rows += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx = x * x
        yy = y * y
        zz = z * z
        xy = x * y
        rows += [
            C2[0] * xy,
            -C2[0] * (y * z),
            C2[1] * (2.0 * zz - xx - yy),
            -C2[0] * (x * z),
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        around = 4.0 * zz - xx - yy
        rows += [
            -C3[0] * y * (3.0 * xx - yy),
            C3[1] * xy * z,
            -C3[2] * y * around,
            C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -C3[2] * x * around,
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3.0 * yy),
        ]
    return rows


@lru_cache(maxsize=1)
def _directions() -> tuple[Tensor, Tensor]:
    """Random unit directions (M, 3), and the basis of degree 3 in them (M, 16), float64."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(
        torch.randn(64, 3, generator=generator, **DOUBLES), dim=1
    )
    return directions, torch.stack(basis_rows(directions.T, 3), dim=1)


def sh_matrix(matrix: Tensor, degree: int) -> Tensor:
    """The matrix (2 degree + 1, 2 degree + 1), float64, that rotates the coefficients of one SH
    band of degree 1 to 3, for a rotation of directions by an orthogonal ``matrix`` (3, 3), float64.

    The coefficients ``c'`` of the rotated function satisfy ``Y(d) c' = Y(matrix^T d) c`` for every
    direction ``d``. They are computed by least squares over fixed directions; the solution is
    exact, because rotations preserve bands.
    """
    directions, basis = _directions()
    band = slice(degree**2, (degree + 1) ** 2)
    turned = torch.stack(basis_rows((directions @ matrix.cpu()).T, degree), dim=1)[:, band]
    return torch.linalg.lstsq(basis[:, band], turned).solution.to(matrix.device)
