"""How many Gaussians to keep."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from numbers import Integral, Real

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.io.ply import ply_bytes

WANTED = (
    "expected a ratio above 0 and up to 1.0 (such as 0.3), a percentage (30%), a whole number of Gaussians "
    "(such as 50000) or a size (12MB)"
)

AUTO_PSNR = 35.0
"""PSNR in dB, against the dense scene's own renders, that ``auto`` means. An independent error of this size lowers the
PSNR against photos from 30 dB by 1.2 dB, and from 25 dB by 0.4 dB."""


@dataclass(frozen=True)
class Megabytes:
    """A budget: the largest size of the PLY file, in units of 10^6 bytes."""

    value: float


@dataclass(frozen=True)
class WithinPsnr:
    """A budget: the smallest scene whose renders reach this PSNR (dB) against the dense scene's own."""

    value: float


Keep = float | int | Megabytes | WithinPsnr


def resolve_keep(n: int, keep: Keep | str, sh_degree: int = 3) -> int:
    """The number of Gaussians that a budget means for a scene of ``n``.

    The type decides: a float is a ratio and an int is a count, so ``1.0`` keeps everything and ``1`` keeps one
    Gaussian. A ratio gives the nearest count (a half is rounded up), and at least one. A size gives as many Gaussians
    as fit into the file.

    Args:
        n: number of Gaussians in the scene.
        keep: float ratio in (0, 1], int count in 1..n, :class:`Megabytes`, or any of them as :func:`parse_keep` reads
            it.
        sh_degree: SH degree of the scene that will be written; only a size depends on it.

    Returns:
        The count, in 1..n.

    Raises:
        BudgetError: if ``keep`` is out of range, NaN or not a number, if it can only be resolved by rendering
            (:class:`WithinPsnr`), or if the scene is empty.

    Example:
        >>> resolve_keep(1000, 0.3), resolve_keep(1000, 1), resolve_keep(1000, 1.0), resolve_keep(1000, "25%")
        (300, 1, 1000, 250)
        >>> resolve_keep(1000, Megabytes(0.1), sh_degree=0)
        1000
    """
    if isinstance(keep, str):
        keep = parse_keep(keep)
    if isinstance(keep, WithinPsnr):
        raise BudgetError("keep is auto, which is found by rendering; expected a ratio, a count or a size here")
    if isinstance(keep, Megabytes):
        return _that_fit(n, keep.value, sh_degree)
    if isinstance(keep, bool) or not isinstance(keep, Real):
        raise BudgetError(f"keep is {keep!r}; {WANTED}")
    if n < 1:
        raise BudgetError(f"keep is {keep!r} but the scene holds no Gaussians; expected at least one")
    if isinstance(keep, Integral):
        if not 1 <= keep <= n:
            raise BudgetError(f"keep is {int(keep)} Gaussians; expected 1 to {n}, the number in the scene")
        return int(keep)
    if not 0 < keep <= 1:  # NaN fails too
        raise BudgetError(f"keep is {float(keep)!r}; {WANTED}")
    return min(n, max(1, int(n * float(keep) + 0.5)))


def _that_fit(n: int, megabytes: float, sh_degree: int) -> int:
    """How many of ``n`` Gaussians fit into a PLY file of ``megabytes``."""
    if not 0 < megabytes < math.inf:
        raise BudgetError(f"keep is {megabytes:g}MB; {WANTED}")
    if n < 1:
        raise BudgetError(f"keep is {megabytes:g}MB but the scene holds no Gaussians; expected at least one")
    limit = math.floor(megabytes * 1e6)
    each = ply_bytes(1, sh_degree) - ply_bytes(0, sh_degree)
    count = min(n, max(0, (limit - ply_bytes(0, sh_degree)) // each))
    while count > 0 and ply_bytes(count, sh_degree) > limit:  # the header holds the count's digits
        count -= 1
    if count < 1:
        least = ply_bytes(1, sh_degree)
        raise BudgetError(
            f"keep is {megabytes:g}MB, too small for one Gaussian of SH degree {sh_degree}; expected at least "
            f"{least / 1e6:g}MB"
        )
    return count


def parse_keep(text: str) -> Keep:
    """Parse a budget: ``0.3`` and ``30%`` are ratios, ``50000`` is a count, ``12MB`` is a size, ``auto`` and
    ``auto:35`` are the PSNR (dB) that renders must reach against the dense scene's own.

    Raises:
        BudgetError: if it is none of these. The range of a ratio, count or size is checked by :func:`resolve_keep`.

    Example:
        >>> parse_keep("30%"), parse_keep("50000"), parse_keep("1"), parse_keep("1.0"), parse_keep("12MB")
        (0.3, 50000, 1, 1.0, Megabytes(value=12.0))
    """
    text = text.strip()
    try:
        if text == "auto":
            return WithinPsnr(AUTO_PSNR)
        if text.startswith("auto:"):
            psnr = float(text[5:].removesuffix("dB"))
            if not 0 < psnr < math.inf:
                raise ValueError
            return WithinPsnr(psnr)
        if re.fullmatch(r".*[mM][bB]", text):
            return Megabytes(float(text[:-2]))
        if text.endswith("%"):
            return float(text[:-1]) / 100
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError as error:
        raise BudgetError(f"keep is {text!r}; {WANTED}, or auto or auto:DB (such as auto:35)") from error
