"""The rows of the tables: ways of making a scene smaller, by name; and the paper's figures (arXiv
2604.09903), for comparison on the same datasets only."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from pointsplat_ns.pruning.paper import DEFAULT_OPACITY_WEIGHT


@dataclass(frozen=True)
class Protocol:
    """Settings of the paper's tables; :mod:`lab.tables.sources` says where each is stated."""

    shares: tuple[float, ...] = (0.5, 0.3, 0.1)
    """Shares of the Gaussians in Tables 1 and 2."""
    ablation_share: float = 0.1
    """Share of the Gaussians in Tables 3 and 4."""
    opacity_weights: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)
    """Lambda in Table 3."""
    datasets: tuple[str, ...] = ("ScanNet++", "Replica")
    """In the order of the paper's columns."""
    dense_steps: int = 15_000
    """Number of Splatfacto's steps for a dense scene, in the README of the released code."""
    figure_share: float = 0.5
    """Share of the Gaussians in Figures 3 and 4."""
    seed: int = 0
    """Seed of the order of views in fine-tuning, and of random selection. No other step is
    random."""


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
        parts = {"appearance branch": self.use_appearance, "position encoding": self.use_position}
        without = " and ".join(part for part, used in parts.items() if not used)
        weight = "" if self.opacity_weight is None else f", lambda {self.opacity_weight:g}"
        words = f"{self.encoder} encoder" + (f" without {without}" if without else "")
        return f"{words}, trained on scenes pruned by {self.by}{weight}"

    def options(self, share: float, own: bool = False) -> dict[str, str]:
        """The options of ``ns-train pointsplat`` that make such a network for a share of the
        Gaussians; with ``own``, on training photos."""
        options = {"encoder": self.encoder, "by": self.by, "keep": f"{share:g}"}
        options |= (
            {} if self.opacity_weight is None else {"opacity-weight": f"{self.opacity_weight:g}"}
        )
        options |= {} if self.use_appearance else {"use-appearance": "False"}
        options |= {} if self.use_position else {"use-position": "False"}
        named = {f"pipeline.model.{name}": value for name, value in options.items()}
        return named | ({"pipeline.datamanager.supervision": "photos"} if own else {})

    def command(self, share: float, own: bool = False) -> str:
        """The command that trains such a network: on other scenes than those that are measured, or
        on the training photos of these (``own``).

        Example:
            >>> Network("concat", "random", None).command(0.3)
            'ns-train pointsplat --data OTHER_SCENES --pipeline.model.encoder concat \
--pipeline.model.by random --pipeline.model.keep 0.3'
        """
        words = " ".join(f"--{name} {value}" for name, value in self.options(share, own).items())
        scenes = "THESE_SCENES" if own else "OTHER_SCENES"
        return f"ns-train pointsplat --data {scenes} {words}"


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
    own: bool = False
    """Whether the refiner was trained on the training photos of the scenes that are measured, as
    the released configuration for Replica does; if not, it saw other scenes only."""
    repaired: bool = False
    """Whether ``compact`` makes it."""
    mode: int | None = None
    """Index of splat-transform's mode; None for other ways."""

    @property
    def protocols(self) -> tuple[Way, ...]:
        """This way, or for one with a network both protocols: *unseen* and *own photos*."""
        if self.network is None:
            return (self,)
        unseen = replace(self, label=f"{self.label}, unseen")
        return unseen, replace(
            self, name=f"{self.name}-own", label=f"{self.label}, own photos", own=True
        )

    @property
    def saw(self) -> str:
        """What the network was trained on, in a cell of a table; empty without a network."""
        return "" if self.network is None else "own photos" if self.own else "other scenes"


@dataclass(frozen=True)
class Ways:
    """All ways, and the rows that the tables have of them. A star in a label marks ways without
    fine-tuning."""

    dense: Way = Way("dense", "3DGS (dense)")

    # The paper's, by images of the scene.
    lightgaussian: Way = Way("lightgaussian", "LightGaussian*", "lightgaussian")
    lightgaussian_tuned: Way = Way(
        "lightgaussian-tuned", "LightGaussian", "lightgaussian", fine_tuned=True
    )
    pup: Way = Way("pup", "PUP-3DGS*", "pup")
    pup_tuned: Way = Way("pup-tuned", "PUP-3DGS", "pup", fine_tuned=True)

    # The paper's, by the Gaussians alone.
    splatformer: Way = Way(
        "splatformer", "SplatFormer", "random", network=Network("concat", "random", None)
    )
    """The paper does not say how the Gaussians of this row are selected; not by its own score,
    which "boosts" it."""
    paper: Way = Way("paper", "PointSplat*", "paper")
    paper_splatformer: Way = Way(
        "paper-splatformer", "PointSplat* + SplatFormer", "paper", network=Network("concat")
    )
    pointsplat: Way = Way("pointsplat", "PointSplat", "paper", network=Network())

    # The defaults of this package's commands.
    merge: Way = Way("merge", "merge (our default)", "merge")
    compact: Way = Way("compact", "compact", "merge", repaired=True)

    # The modes of another program.
    splat_transform: Way = Way("splat-transform", "splat-transform", mode=0)
    splat_transform_adaptive: Way = Way(
        "splat-transform-adaptive", "splat-transform, adaptive", mode=1
    )

    @property
    def table_1(self) -> tuple[Way, ...]:
        """The rows of Table 1 for each share; the dense scene stands above them."""
        by_images = (self.lightgaussian, self.lightgaussian_tuned, self.pup, self.pup_tuned)
        return (*by_images, *self._by_gaussians, *self._not_of_the_paper)

    @property
    def table_2(self) -> tuple[Way, ...]:
        """The rows of Table 2 for each share; those of the paper, its selection and ours."""
        paper = (self.lightgaussian_tuned, self.pup_tuned, self.paper, *self.pointsplat.protocols)
        return (*paper, *self._not_of_the_paper)

    @property
    def table_3(self) -> tuple[tuple[float, Way], ...]:
        """Lambda and way of each row of Table 3: the paper's selection, and refined, by both
        protocols."""
        found: list[tuple[float, Way]] = []
        for weight in PROTOCOL.opacity_weights:
            selected = self.paper
            refined = self.pointsplat
            if weight != DEFAULT_OPACITY_WEIGHT:
                network = Network(opacity_weight=weight)
                selected = Way(f"paper-{weight:g}", self.paper.label, "paper", weight)
                refined = Way(
                    f"pointsplat-{weight:g}",
                    self.pointsplat.label,
                    "paper",
                    weight,
                    network=network,
                )
            found += [(weight, way) for way in (selected, *refined.protocols)]
        return tuple(found)

    @property
    def table_4(self) -> tuple[Way, ...]:
        """Rows I to V of Table 4; from II on by both protocols."""
        parts = {"ii": (False, False), "iii": (False, True), "iv": (True, False)}
        ablated = (
            Way(
                f"pointsplat-{row}",
                row.upper(),
                "paper",
                network=Network(use_appearance=first, use_position=second),
            )
            for row, (first, second) in parts.items()
        )
        return (self.paper, *both(ablated), *self.pointsplat.protocols)

    @property
    def figure_4(self) -> tuple[Way, ...]:
        """Ways in Figure 4: the dense scene, the paper's three, and the default of this package."""
        return (self.dense, self.lightgaussian, self.pup, self.paper, self.merge)

    def cells(self, shares: Sequence[float]) -> list[tuple[Way, float]]:
        """Every way and share of all tables, those of Table 1 given, each once, in the order of
        measurement: quick ones first."""
        ablations = dict.fromkeys([*(way for _, way in self.table_3), *self.table_4])
        cells = [(self.dense, 1.0), *((way, PROTOCOL.ablation_share) for way in ablations)]
        quick = (*self._by_gaussians, self.merge, self.compact)
        cells += [
            (way, share) for way in dict.fromkeys([*quick, *self.table_1]) for share in shares
        ]
        return list(dict.fromkeys(cells))

    @property
    def _by_gaussians(self) -> tuple[Way, ...]:
        return tuple(both((self.splatformer, self.paper, self.paper_splatformer, self.pointsplat)))

    @property
    def _not_of_the_paper(self) -> tuple[Way, ...]:
        return (self.merge, self.compact, self.splat_transform, self.splat_transform_adaptive)


def both(ways: Iterable[Way]) -> Iterator[Way]:
    """Ways, those with a network by both protocols."""
    for way in ways:
        yield from way.protocols


WAYS = Ways()


def cell_key(scene: str, way: Way, share: float) -> str:
    """The key of a cell.

    Example:
        >>> cell_key("fox", WAYS.merge, 0.1)
        'fox/merge/10%'
    """
    return f"{scene}/{way.name}/{100 * share:g}%"


_PUBLISHED: dict[int, dict[tuple[str, float], tuple[float, ...]]] = {
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
        ("paper", 0.1): (
            21.87,
            0.836,
            0.377,
            17.60,
            0.802,
            0.397,
        ),  # Table 1 has 21.88 and 0.838 on ScanNet++
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

PUBLISHED_METRICS = ("psnr", "ssim", "lpips_vgg")
"""Their names in cells: the released code measures LPIPS by VGG (``utils/metrics.py``)."""


def published(
    table: int, dataset: str, way: str, share: float
) -> tuple[float, float, float] | None:
    """The paper's PSNR (dB), SSIM and LPIPS of a row, by its way and share, against held-out photos
    in table 1, 3 or 4; None if there are none. Rows of both protocols have the same: which one the
    paper's are is not stated.

    Example:
        >>> published(1, "Replica", "pointsplat", 0.1)
        (29.81, 0.902, 0.276)
    """
    figures = _PUBLISHED[table].get((way.removesuffix("-own"), share), ())
    first = {"ScanNet++": 0, "Replica": 3}.get(dataset, len(figures))
    return figures[first : first + 3] or None  # type: ignore[return-value]
