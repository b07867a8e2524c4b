"""Budgets: the number of Gaussians to keep."""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.scene.formats import WRITABLE, format_named, format_to_write
from pointsplat_ns.scene.gaussians import PLAIN, Traits
from pointsplat_ns.system.quantities import parse_count, parse_megabytes, parse_number

KEEP_FORMS = (
    "expected a ratio above 0 and up to 1.0 (such as 0.3), a percentage (30%), a whole number of "
    "Gaussians (such as 50000 or 50k) or a size (12MB)"
)


@dataclass(frozen=True)
class Megabytes:
    """A budget: maximum file size in MB (10^6 bytes), with the suffix of the format. Raises
    BudgetError if it is not positive, or the format cannot be written."""

    value: float
    suffix: str = ".ply"

    def __post_init__(self) -> None:
        kind = format_named(self.suffix)
        if kind is None or kind.write is None:
            raise BudgetError(
                f"keep is the size of a {self.suffix} file; expected one of {WRITABLE}"
            )
        if not 0 < self.value < math.inf:  # NaN fails too
            raise BudgetError(f"keep is {self}; {KEEP_FORMS}")

    @property
    def bytes(self) -> int:
        """The maximum size."""
        return math.floor(self.value * 1e6)

    @property
    def bytes_of(self) -> Callable[[int, int, Traits], int] | None:
        """File size, bytes, from count, SH degree and traits; None if it is known only after
        writing."""
        return format_to_write(self.suffix).bytes_of

    def __str__(self) -> str:
        return f"{self.value:g}MB" + (self.suffix if self.suffix != ".ply" else "")


@dataclass(frozen=True)
class WithinPsnr:
    """A budget: the smallest scene whose renders reach this PSNR (dB) against the dense scene, with
    numbers rounded for the format of a suffix. Raises BudgetError if it is not positive."""

    value: float
    suffix: str = ".ply"

    def __post_init__(self) -> None:
        if not 0 < self.value < math.inf:  # NaN fails too
            raise BudgetError(
                f"the wanted PSNR is {self.value} dB; expected a positive number, such as 35"
            )

    def __str__(self) -> str:
        return f"auto:{self.value:g}" + (self.suffix if self.suffix != ".ply" else "")


class BareCount(int):
    """A count typed as digits alone, such as 10, which may be meant as a percentage."""


Keep = float | int | Megabytes | WithinPsnr


def resolve_keep(n: int, keep: Keep | str, sh_degree: int = 3, traits: Traits = PLAIN) -> int:
    """Number of Gaussians for a budget and a scene of ``n``.

    The type decides: a float is a ratio and an int is a count, so ``1.0`` keeps everything and
    ``1`` keeps one Gaussian. A ratio gives the nearest count, and at least one. A size gives the
    largest count that fits.

    Args:
        n: number of Gaussians in the scene.
        keep: float ratio in (0, 1], int count from 1 on, :class:`Megabytes`, or any of them as
            text.
        sh_degree, traits: of the scene to write; used only for a size.

    Returns:
        The count, in 1..n.

    Raises:
        BudgetError: if ``keep`` is out of range, NaN or not a number, if it is
            :func:`found_by_trying`, or if the scene is empty.

    Example:
        >>> [resolve_keep(1000, keep) for keep in (0.3, 1, 1.0, "25%", 2000)]
        [300, 1, 1000, 250, 1000]
    """
    if isinstance(keep, str):
        keep = parse_keep(keep)
    if isinstance(keep, WithinPsnr):
        raise BudgetError(
            "keep is auto, which needs rendering; expected a ratio, a count or a size here"
        )
    if isinstance(keep, bool) or not isinstance(keep, (Megabytes, Real)):
        raise BudgetError(f"keep is {keep!r}; {KEEP_FORMS}")
    if n < 1:
        raise BudgetError(f"keep is {keep} but the scene has no Gaussians; expected at least one")
    if isinstance(keep, Megabytes):
        return _count_that_fits(n, keep, sh_degree, traits)
    if isinstance(keep, Integral):
        if keep < 1:
            raise BudgetError(f"keep is {int(keep)} Gaussians; expected at least 1")
        if isinstance(keep, BareCount) and keep < 100 and n >= 5000:
            raise BudgetError(
                f"keep is {int(keep)}, of {n:,} Gaussians; did you mean {int(keep)}%? Write "
                f"{int(keep)}gaussians if you mean that count"
            )
        return min(int(keep), n)
    if not 0 < keep <= 1:  # NaN fails too
        raise BudgetError(f"keep is {float(keep)!r}; {KEEP_FORMS}")
    return min(n, max(1, int(n * float(keep) + 0.5)))


def found_by_trying(keep: Keep) -> bool:
    """Whether the count of a budget is found only by trials: for a PSNR, or for the size of a
    compressed file."""
    return isinstance(keep, WithinPsnr) or isinstance(keep, Megabytes) and keep.bytes_of is None


def _count_that_fits(n: int, keep: Megabytes, sh_degree: int, traits: Traits) -> int:
    """Largest number of Gaussians, at most ``n``, whose file is within the budget."""
    bytes_of = keep.bytes_of
    if bytes_of is None:
        raise BudgetError(
            f"keep is {keep}, which needs writing; expected a ratio, a count or the size of a .ply "
            "here"
        )
    # The size never decreases with the count, but grows unevenly: headers contain the count, and
    # chunks are padded.
    count = bisect.bisect_right(
        range(1, n + 1), keep.bytes, key=lambda count: bytes_of(count, sh_degree, traits)
    )
    if count < 1:
        least = bytes_of(1, sh_degree, traits)
        raise BudgetError(
            f"keep is {keep}, too small for one Gaussian of SH degree {sh_degree}; expected at "
            f"least {least / 1e6:g}MB"
        )
    return count


def parse_keep(text: str, suffix: str = ".ply") -> Keep:
    """Parse a budget.

    ``0.3`` and ``30%`` are ratios; ``50000``, ``50k`` and ``12 Gaussians`` are counts; ``12MB`` and
    ``800kB.spz`` are sizes; ``auto``, ``auto:35`` and ``auto:35.sog`` are the PSNR (dB) of renders
    against the dense scene. A size or a PSNR without a format is for files with ``suffix``.

    Raises:
        BudgetError: for any other text. The range of a ratio or count is checked by
            :func:`resolve_keep`.

    Example:
        >>> [parse_keep(text) for text in ("30%", "50000", "1", "1.0")], parse_keep("12MB")
        ([0.3, 50000, 1, 1.0], Megabytes(value=12.0, suffix='.ply'))
    """
    text = text.strip()
    try:
        if auto := re.fullmatch(r"auto(?::(.+?)(?:dB)?)?(\.[a-z]\S*)?", text):
            # An independent error of 35 dB lowers a PSNR of 30 dB against photos by 1.2 dB, and one
            # of 25 dB by 0.4 dB.
            return WithinPsnr(35.0 if auto[1] is None else float(auto[1]), auto[2] or suffix)
        if size := re.fullmatch(r"(.*\d *[kmg]?b)(\.\S+)?", text, re.IGNORECASE):
            return Megabytes(parse_megabytes(size[1]), (size[2] or suffix).lower())
        if text.endswith("%"):
            return parse_number(text[:-1]) / 100
        if count := re.fullmatch(r"(.*\d *[kmg]?) *gaussians?", text, re.IGNORECASE):
            return parse_count(count[1])
        if re.fullmatch(r"[+-]?\d+", text):
            return BareCount(text)
        number = parse_number(text)
        return (
            int(number) if number > 1 and number == int(number) or text[-1] in "kKmMgG" else number
        )
    except BudgetError:
        raise
    except ValueError as error:
        raise BudgetError(
            f"keep is {text!r}; {KEEP_FORMS}, or auto or auto:DB (such as auto:35)"
        ) from error
