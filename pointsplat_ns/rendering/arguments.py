"""Checks arguments of :func:`~pointsplat_ns.rendering.rasterize.rasterization`.

Values of tensors are not checked.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from pointsplat_ns.rendering.constants import QUALITIES


def check_tensors(
    colors: Tensor | tuple[Tensor, Tensor],
    sh_degree: int | None,
    backgrounds: Tensor | None,
    **tensors: Tensor,
) -> None:
    """Raise a ValueError that names the argument if a shape does not match. Values are not checked,
    because reading them would synchronise with the device."""
    n, c = (tensors[name].shape[0] if tensors[name].dim() else 0 for name in ("means", "viewmats"))
    wanted = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "viewmats": (c, 4, 4),
        "Ks": (c, 3, 3),
    }
    for name, expected in wanted.items():
        if tuple(tensors[name].shape) != expected:
            raise ValueError(f"{name} has shape {tuple(tensors[name].shape)}; expected {expected}")
    if c == 0:
        raise ValueError("viewmats has no camera; expected at least one")
    shape = (
        tuple(colors.shape) if isinstance(colors, Tensor) else _shape_together(colors, n, sh_degree)
    )
    channels = _check_channels(shape, n, sh_degree is not None)
    if backgrounds is not None and tuple(backgrounds.shape) != (c, channels):
        raise ValueError(
            f"backgrounds has shape {tuple(backgrounds.shape)}; expected {(c, channels)}"
        )


def _shape_together(
    colors: tuple[Tensor, Tensor], n: int, sh_degree: int | None
) -> tuple[int, ...]:
    """Shape of one tensor with the first SH coefficients and the others."""
    shapes = [tuple(tensor.shape) for tensor in colors]
    if sh_degree is None:
        raise ValueError(
            f"colors are {len(shapes)} tensors, which are SH coefficients; they need sh_degree"
        )
    if len(shapes) != 2 or shapes[0] != (n, 3) or len(shapes[1]) != 3 or shapes[1][::2] != (n, 3):
        raise ValueError(
            f"colors have shapes {', '.join(map(str, shapes))}; expected SH coefficients ({n}, 3) "
            f"and ({n}, K - 1, 3)"
        )
    return (n, 1 + shapes[1][1], 3)


def _check_channels(shape: tuple[int, ...], n: int, harmonics: bool) -> int:
    """Number of channels of colours, or 3 for SH coefficients."""
    if harmonics and (len(shape) != 3 or shape[::2] != (n, 3)):
        raise ValueError(f"colors has shape {shape}; expected SH coefficients ({n}, K, 3)")
    if not harmonics and (shape[:-1] != (n,) or shape[-1] < 1):
        hint = "; SH coefficients need sh_degree" if shape == (n, *shape[1:2], 3) else ""
        raise ValueError(f"colors has shape {shape}; expected ({n}, channels){hint}")
    return shape[-1]


def check_options(
    width: int, height: int, near_plane: float, far_plane: float, **others: Any
) -> None:
    """Raise a ValueError that names the argument if a number or name is invalid."""
    if not (
        hasattr(width, "__index__") and hasattr(height, "__index__") and width >= 1 and height >= 1
    ):
        raise ValueError(
            f"image is {width} x {height} pixels; expected whole numbers, at least 1 x 1"
        )
    if not 0 <= near_plane < far_plane:  # NaN fails too, here and below
        raise ValueError(
            f"near_plane is {near_plane} and far_plane {far_plane}; expected 0 <= near_plane < "
            "far_plane"
        )
    for name in ("radius_clip", "eps2d"):
        if not 0 <= others[name] < float("inf"):
            raise ValueError(f"{name} is {others[name]}; expected a number from 0")
    if not others["memory_budget"] > 0:
        raise ValueError(
            f"memory_budget is {others['memory_budget']}; expected a number of bytes above 0"
        )
    modes = {
        "render_mode": ("RGB", "D", "ED", "RGB+D", "RGB+ED"),
        "rasterize_mode": ("classic", "antialiased"),
        "quality": tuple(QUALITIES),
    }
    for name, names in modes.items():
        if others[name] not in names:
            raise ValueError(
                f"{name} is {others[name]!r}; expected {', '.join(names[:-1])} or {names[-1]}"
            )
