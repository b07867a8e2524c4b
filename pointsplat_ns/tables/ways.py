"""The rows of the paper's tables and of ours: ways of making a scene smaller, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pointsplat_ns.pruning.scores import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.tradeoff.settings import DENSE, Repair

SHARES = (0.5, 0.3, 0.1)
"""Shares of the Gaussians that the paper's Tables 1 and 2 keep."""

ABLATED = 0.1
"""The share of its Tables 3 and 4."""

WEIGHTS = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Lambda of its Table 3."""

FIGURE_SHARE = 0.5
"""The share of its Figure 4."""

SEED = 0
"""Of the order in which fine-tuning sees views, and of a random selection. Nothing else here is random."""


@dataclass(frozen=True)
class Network:
    """What the weights of a refiner have to be for a row: which network, trained on scenes pruned how."""

    encoder: Literal["dual", "concat"] = "dual"
    by: str = "paper"
    opacity_weight: float | None = DEFAULT_OPACITY_WEIGHT
    """Lambda of the selection that it was trained on; None for methods that have none."""
    use_appearance: bool = True
    use_position: bool = True

    def __str__(self) -> str:
        names = {"dual": "dual encoder", "concat": "concat encoder"}
        without = [
            text
            for used, text in ((self.use_appearance, "appearance branch"), (self.use_position, "position encoding"))
            if not used
        ]
        words = names[self.encoder] + (f" without {' and '.join(without)}" if without else "")
        weight = "" if self.opacity_weight is None else f", lambda {self.opacity_weight:g}"
        return f"{words}, trained on scenes pruned by {self.by}{weight}"


@dataclass(frozen=True)
class Way:
    """A way of making a scene smaller."""

    name: str
    """As cells call it; fit for a shell without quotes."""
    label: str
    """As tables call it."""
    by: str = ""
    """The method of pruning; empty for what another program does."""
    opacity_weight: float | None = None
    """Lambda of the paper's score; None for its default, and for methods that have none."""
    fine_tuned: bool = False
    """Whether it is optimised for the scene afterwards, against its training photos."""
    network: Network | None = None
    """The refiner that repairs it, if one does."""
    repair: Repair = "none"
    """The effort of ``compact``."""
    mode: int | None = None
    """For splat-transform: which of its modes."""


DENSE_WAY = Way(DENSE, "3DGS (dense)")

IMAGE_DRIVEN = (
    Way("lightgaussian", "LightGaussian*", "lightgaussian"),
    Way("lightgaussian-tuned", "LightGaussian", "lightgaussian", fine_tuned=True),
    Way("pup", "PUP-3DGS*", "pup"),
    Way("pup-tuned", "PUP-3DGS", "pup", fine_tuned=True),
)
"""Methods that look at images of the scene; the star says that nothing was fine-tuned."""

PAPER = Way("paper", "PointSplat*", "paper")
POINTSPLAT = Way("pointsplat", "PointSplat", "paper", network=Network())

GEOMETRY_DRIVEN = (
    # The paper does not say what selects the Gaussians of this row. Not its own score, which "boosts" it.
    Way("splatformer", "SplatFormer", "random", network=Network("concat", "random", None)),
    PAPER,
    Way("paper-splatformer", "PointSplat* + SplatFormer", "paper", network=Network("concat")),
    POINTSPLAT,
)
"""Methods of the paper that look at nothing but the Gaussians."""

MERGE = Way("merge", "merge (our default)", "merge")
OURS = (MERGE, Way("compact", "compact", "merge", repair="quick"))
"""What ``pointsplat prune`` and ``pointsplat compact`` do by default."""

PEERS = (
    Way("splat-transform", "splat-transform", mode=0),
    Way("splat-transform-adaptive", "splat-transform, adaptive", mode=1),
)
"""The modes of another program."""

TABLE_1 = (*IMAGE_DRIVEN, *GEOMETRY_DRIVEN, *OURS, *PEERS)


def selected(weight: float) -> Way:
    """The paper's selection at a lambda."""
    return PAPER if weight == DEFAULT_OPACITY_WEIGHT else Way(f"paper-{weight:g}", PAPER.label, "paper", weight)


def refined(weight: float) -> Way:
    """And refined."""
    if weight == DEFAULT_OPACITY_WEIGHT:
        return POINTSPLAT
    network = Network(opacity_weight=weight)
    return Way(f"pointsplat-{weight:g}", POINTSPLAT.label, "paper", weight, network=network)


TABLE_3 = tuple((weight, way(weight)) for weight in WEIGHTS for way in (selected, refined))


def _ablated(name: str, label: str, appearance: bool, position: bool) -> Way:
    return Way(name, label, "paper", network=Network(use_appearance=appearance, use_position=position))


TABLE_4 = (
    PAPER,
    _ablated("pointsplat-ii", "II", False, False),
    _ablated("pointsplat-iii", "III", False, True),
    _ablated("pointsplat-iv", "IV", True, False),
    POINTSPLAT,
)
"""Rows I to V."""

FIGURE_4 = (IMAGE_DRIVEN[0], IMAGE_DRIVEN[2], PAPER, MERGE)
"""Whose Gaussians Figure 4 shows: the paper's three, and our default."""

FIGURE_CELLS = {(DENSE, 1.0), *((way.name, FIGURE_SHARE) for way in FIGURE_4)}
"""Ways and shares whose distributions are kept for it."""


def all_cells(shares: Sequence[float]) -> list[tuple[Way, float]]:
    """Every way and share of all tables, each once, in the order in which they are measured: what takes little time
    first.

    Args:
        shares: of Table 1.
    """
    cells = [(DENSE_WAY, 1.0), *((way, ABLATED) for _, way in TABLE_3), *((way, ABLATED) for way in TABLE_4)]
    cells += [(way, share) for way in (*GEOMETRY_DRIVEN, *OURS, *IMAGE_DRIVEN, *PEERS) for share in shares]
    return list(dict.fromkeys(cells))


def cell_key(scene: str, way: Way, share: float) -> str:
    """What a cell is called.

    Example:
        >>> cell_key("fox", MERGE, 0.1)
        'fox/merge/10%'
    """
    return f"{scene}/{way.name}/{100 * share:g}%"
