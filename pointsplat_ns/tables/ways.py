"""The rows of the tables: ways of making a scene smaller, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pointsplat_ns.pruning.scores import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.tradeoff.settings import DENSE, Repair


@dataclass(frozen=True)
class Protocol:
    """Settings of the paper's tables."""

    shares: tuple[float, ...] = (0.5, 0.3, 0.1)
    """Shares of the Gaussians in Tables 1 and 2."""
    ablation_share: float = 0.1
    """Share of the Gaussians in Tables 3 and 4."""
    opacity_weights: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)
    """Lambda in Table 3."""
    figure_share: float = 0.5
    """Share of the Gaussians in Figure 4."""
    seed: int = 0
    """Seed of the order of views in fine-tuning, and of random selection. No other step is random."""


PROTOCOL = Protocol()


@dataclass(frozen=True)
class Network:
    """The refiner that a row needs: its architecture, and the pruning of its training scenes."""

    encoder: Literal["dual", "concat"] = "dual"
    by: str = "paper"
    opacity_weight: float | None = DEFAULT_OPACITY_WEIGHT
    """Lambda of that pruning; None for methods without it."""
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
    """Name in keys of cells; needs no quotes in a shell."""
    label: str
    """Name in tables."""
    by: str = ""
    """Method of pruning; empty for another program."""
    opacity_weight: float | None = None
    """Lambda of the paper's score; None for its default, and for methods without it."""
    fine_tuned: bool = False
    """Whether the scene is fine-tuned against its training photos."""
    network: Network | None = None
    """The refiner; None for none."""
    repair: Repair = "none"
    """Effort of ``compact``."""
    mode: int | None = None
    """Index of splat-transform's mode; None for other ways."""


DENSE_WAY = Way(DENSE, "3DGS (dense)")

IMAGE_DRIVEN = (
    Way("lightgaussian", "LightGaussian*", "lightgaussian"),
    Way("lightgaussian-tuned", "LightGaussian", "lightgaussian", fine_tuned=True),
    Way("pup", "PUP-3DGS*", "pup"),
    Way("pup-tuned", "PUP-3DGS", "pup", fine_tuned=True),
)
"""Methods that use images of the scene; a star marks methods without fine-tuning."""

PAPER = Way("paper", "PointSplat*", "paper")
POINTSPLAT = Way("pointsplat", "PointSplat", "paper", network=Network())

GEOMETRY_DRIVEN = (
    # The paper does not say how the Gaussians of this row are selected; not by its own score, which "boosts" it.
    Way("splatformer", "SplatFormer", "random", network=Network("concat", "random", None)),
    PAPER,
    Way("paper-splatformer", "PointSplat* + SplatFormer", "paper", network=Network("concat")),
    POINTSPLAT,
)
"""Methods of the paper that use the Gaussians alone."""

MERGE = Way("merge", "merge (our default)", "merge")
OURS = (MERGE, Way("compact", "compact", "merge", repair="quick"))
"""The defaults of ``pointsplat prune`` and ``pointsplat compact``."""

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
    """The paper's selection at a lambda, refined."""
    if weight == DEFAULT_OPACITY_WEIGHT:
        return POINTSPLAT
    network = Network(opacity_weight=weight)
    return Way(f"pointsplat-{weight:g}", POINTSPLAT.label, "paper", weight, network=network)


TABLE_3 = tuple((weight, way(weight)) for weight in PROTOCOL.opacity_weights for way in (selected, refined))


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

FIGURE_4 = (
    (DENSE_WAY, 1.0),
    *((way, PROTOCOL.figure_share) for way in (IMAGE_DRIVEN[0], IMAGE_DRIVEN[2], PAPER, MERGE)),
)
"""Ways and shares in Figure 4: the dense scene, the paper's three, and the default of this package."""


def all_cells(shares: Sequence[float]) -> list[tuple[Way, float]]:
    """Every way and share of all tables, those of Table 1 given, each once, in the order of measurement: quick ones
    first."""
    ablations = dict.fromkeys([*(way for _, way in TABLE_3), *TABLE_4])
    cells = [(DENSE_WAY, 1.0), *((way, PROTOCOL.ablation_share) for way in ablations)]
    cells += [(way, share) for way in (*GEOMETRY_DRIVEN, *OURS, *IMAGE_DRIVEN, *PEERS) for share in shares]
    return list(dict.fromkeys(cells))


def cell_key(scene: str, way: Way, share: float) -> str:
    """The key of a cell.

    Example:
        >>> cell_key("fox", MERGE, 0.1)
        'fox/merge/10%'
    """
    return f"{scene}/{way.name}/{100 * share:g}%"
