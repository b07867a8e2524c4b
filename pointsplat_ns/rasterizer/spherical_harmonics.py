"""Real spherical harmonics up to degree 3, and colours from them."""

from __future__ import annotations

import torch
from torch import Tensor

# Normalisation constants of the real spherical harmonics (Sloan, "Efficient Spherical Harmonic
# Evaluation", 2013), with the signs that 3DGS files use.
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Basis values for unit directions.

    Args:
        directions: (M, 3) unit vectors, world space.
        degree: 0 to 3.

    Returns:
        (M, (degree + 1)^2)

    Raises:
        ValueError: if the degree is not 0 to 3.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"SH degree is {degree}; expected 0 to 3")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree >= 1:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            C2[0] * (x * y),
            -C2[0] * (y * z),
            C2[1] * (2.0 * zz - xx - yy),
            -C2[0] * (x * z),
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -C3[0] * y * (3.0 * xx - yy),
            C3[1] * (x * y) * z,
            -C3[2] * y * (4.0 * zz - xx - yy),
            C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -C3[2] * x * (4.0 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3.0 * yy),
        ]
    return torch.stack(basis, dim=-1)


def safe_normalize(vectors: Tensor) -> Tensor:
    """Unit vectors (..., D); a zero vector stays zero, with a zero gradient.

    The length is taken after division by the largest component, so that neither 1e-30 nor 1e30
    under- or overflows.
    """
    largest = vectors.detach().abs().amax(dim=-1, keepdim=True)
    zero = largest == 0
    scaled = vectors / torch.where(zero, torch.ones_like(largest), largest)
    length = (scaled * scaled).sum(dim=-1, keepdim=True)
    length = torch.where(zero, torch.ones_like(length), length).sqrt()
    return scaled / length


def sh_to_color(directions: Tensor, coefficients: Tensor, degree: int) -> Tensor:
    """Colours seen along directions, as 3DGS defines them: ``max(SH + 1/2, 0)``.

    Args:
        directions: (M, 3) from the camera centre to the Gaussian, world space, any length.
        coefficients: (M, K, 3) with K >= (degree + 1)^2; the rest is ignored.
        degree: 0 to 3.

    Returns:
        (M, 3), not below 0.
    """
    used = (degree + 1) ** 2
    if coefficients.shape[-2] < used:
        raise ValueError(f"{coefficients.shape[-2]} SH coefficients given; degree {degree} needs {used}")
    if degree == 0:
        color = C0 * coefficients[..., 0, :]
    else:
        basis = sh_basis(safe_normalize(directions), degree)
        color = torch.matmul(basis.unsqueeze(-2), coefficients[..., :used, :]).squeeze(-2)
    return (color + 0.5).clamp_min(0.0)
