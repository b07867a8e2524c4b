"""How many Gaussians to keep."""

from __future__ import annotations

from numbers import Integral, Real

from pointsplat_ns.errors import BudgetError

WANTED = "expected a ratio above 0 and up to 1.0 (such as 0.3) or a whole number of Gaussians (such as 50000)"


def resolve_keep(n: int, keep: float | int) -> int:
    """The number of Gaussians that a budget means for a scene of ``n``.

    The type decides: a float is a ratio and an int is a count, so ``1.0`` keeps everything and ``1``
    keeps one Gaussian. A ratio is rounded to the nearest count, a half up, and keeps at least one.

    Args:
        n: number of Gaussians in the scene.
        keep: float ratio in (0, 1] or int count in 1..n.

    Returns:
        The count, in 1..n.

    Raises:
        BudgetError: if ``keep`` is out of its range, NaN or no number, or if the scene is empty.

    Example:
        >>> resolve_keep(1000, 0.3), resolve_keep(1000, 1), resolve_keep(1000, 1.0)
        (300, 1, 1000)
    """
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


def parse_keep(text: str) -> float | int:
    """A budget as a person types it: ``0.3`` and ``30%`` are ratios, ``50000`` is a count.

    Raises:
        BudgetError: if it is neither. The range is for :func:`resolve_keep` to judge.

    Example:
        >>> parse_keep("30%"), parse_keep("50000"), parse_keep("1"), parse_keep("1.0")
        (0.3, 50000, 1, 1.0)
    """
    text = text.strip()
    try:
        if text.endswith("%"):
            return float(text[:-1]) / 100
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError as error:
        raise BudgetError(f"keep is {text!r}; {WANTED}") from error
