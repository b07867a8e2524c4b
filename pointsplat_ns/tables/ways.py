"""The rows of the tables: ways of making a scene smaller, by name; and the paper's figures (arXiv 2604.09903), for
comparison on the same datasets only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pointsplat_ns.pruning.scores import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.tradeoff.points import ImageMetrics
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
    datasets: tuple[str, ...] = ("ScanNet++", "Replica")
    """In the order of the paper's columns."""
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


_TABLES: dict[int, dict[tuple[str, float], tuple[float, ...]]] = {
    1: {
        ("dense", 1.0): (29.73, 0.925, 0.165, 39.40, 0.974, 0.122),
        ("lightgaussian", 0.5): (28.19, 0.913, 0.188, 32.33, 0.957, 0.143),
        ("lightgaussian-tuned", 0.5): (30.23, 0.929, 0.171, 39.78, 0.974, 0.125),
        ("pup", 0.5): (28.29, 0.913, 0.185, 32.44, 0.955, 0.158),
        ("pup-tuned", 0.5): (31.35, 0.937, 0.159, 39.67, 0.973, 0.121),
        ("lightgaussian", 0.3): (26.13, 0.891, 0.215, 26.86, 0.921, 0.182),
        ("lightgaussian-tuned", 0.3): (29.80, 0.923, 0.183, 38.63, 0.970, 0.135),
        ("pup", 0.3): (24.80, 0.882, 0.224, 23.20, 0.896, 0.200),
        ("pup-tuned", 0.3): (30.85, 0.931, 0.172, 38.64, 0.968, 0.130),
        ("lightgaussian", 0.1): (21.87, 0.836, 0.278, 20.29, 0.837, 0.290),
        ("lightgaussian-tuned", 0.1): (28.12, 0.902, 0.224, 33.37, 0.937, 0.195),
        ("pup", 0.1): (19.82, 0.803, 0.305, 17.34, 0.784, 0.322),
        ("pup-tuned", 0.1): (29.64, 0.915, 0.205, 36.04, 0.951, 0.169),
        ("splatformer", 0.5): (21.27, 0.857, 0.348, 30.79, 0.927, 0.233),
        ("paper", 0.5): (28.81, 0.923, 0.266, 33.97, 0.956, 0.213),
        ("paper-splatformer", 0.5): (29.03, 0.924, 0.264, 34.63, 0.952, 0.192),
        ("pointsplat", 0.5): (29.52, 0.928, 0.258, 35.98, 0.958, 0.191),
        ("splatformer", 0.3): (11.66, 0.691, 0.509, 29.14, 0.903, 0.263),
        ("paper", 0.3): (27.15, 0.909, 0.287, 30.01, 0.934, 0.245),
        ("paper-splatformer", 0.3): (26.66, 0.899, 0.300, 33.04, 0.939, 0.207),
        ("pointsplat", 0.3): (27.70, 0.911, 0.287, 34.46, 0.947, 0.208),
        ("splatformer", 0.1): (10.62, 0.691, 0.569, 8.37, 0.388, 0.677),
        ("paper", 0.1): (21.88, 0.838, 0.377, 17.60, 0.802, 0.397),
        ("paper-splatformer", 0.1): (22.59, 0.847, 0.375, 27.99, 0.888, 0.271),
        ("pointsplat", 0.1): (23.46, 0.855, 0.374, 29.81, 0.902, 0.276),
    },
    3: {
        ("paper-0.1", 0.1): (20.52, 0.824, 0.411, 22.42, 0.846, 0.364),
        ("pointsplat-0.1", 0.1): (21.72, 0.837, 0.406, 28.23, 0.881, 0.281),
        ("paper", 0.1): (21.87, 0.836, 0.377, 17.60, 0.802, 0.397),  # Table 1 has 21.88 and 0.838 on ScanNet++
        ("pointsplat", 0.1): (23.46, 0.855, 0.374, 29.81, 0.902, 0.276),
        ("paper-0.5", 0.1): (20.57, 0.813, 0.402, 15.45, 0.752, 0.433),
        ("pointsplat-0.5", 0.1): (22.72, 0.846, 0.376, 27.71, 0.888, 0.274),
        ("paper-0.7", 0.1): (17.55, 0.751, 0.453, 13.90, 0.700, 0.462),
        ("pointsplat-0.7", 0.1): (20.10, 0.816, 0.410, 27.39, 0.886, 0.281),
        ("paper-0.9", 0.1): (13.74, 0.621, 0.516, 12.48, 0.643, 0.487),
        ("pointsplat-0.9", 0.1): (10.66, 0.686, 0.559, 26.58, 0.882, 0.290),
    },
    4: {  # the paper does not name the dataset, but rows I and V are equal to Table 3 on ScanNet++
        ("paper", 0.1): (21.87, 0.836, 0.377),
        ("pointsplat-ii", 0.1): (22.61, 0.848, 0.384),
        ("pointsplat-iii", 0.1): (22.76, 0.847, 0.385),
        ("pointsplat-iv", 0.1): (22.65, 0.846, 0.388),
        ("pointsplat", 0.1): (23.46, 0.855, 0.374),
    },
}
"""PSNR (dB), SSIM and LPIPS on ScanNet++, then on Replica, by table, way and share."""


def published(table: int, dataset: str, way: str, share: float) -> ImageMetrics | None:
    """The paper's figures of a row, by its way and share, against held-out photos in table 1, 3 or 4; None if there are
    none.

    Example:
        >>> published(1, "Replica", "pointsplat", 0.1)
        ImageMetrics(psnr=29.81, ssim=0.902, lpips=0.276)
    """
    figures = _TABLES[table].get((way, share), ())
    found = {"ScanNet++": figures[:3], "Replica": figures[3:]}.get(dataset)
    return ImageMetrics(*found) if found else None
