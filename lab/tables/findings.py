"""Which claims of the paper hold on the scenes that were measured: differences of rows, with their
spread over scenes, as one paragraph."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from statistics import fmean, stdev
from typing import Literal

from lab.common.results import Row
from lab.tables.ways import PROTOCOL, PUBLISHED_METRICS, WAYS, Way, cell_key, published

Measure = Literal["psnr", "lpips_vgg", "fill", "frame_ms"]

FEW = PROTOCOL.ablation_share


class Verdict(Enum):
    """Whether a claim holds on some scenes."""

    HOLDS = "holds here"
    FAILS = "does not hold here"
    OPEN = "is not decided by these scenes"
    UNKNOWN = "was not measured"


@dataclass(frozen=True)
class Claim:
    """One row is better than others, at one share of the Gaussians."""

    text: str
    better: Way
    than: tuple[Way, ...]
    """The best of these counts."""
    measure: Measure = "psnr"
    """PSNR in held-out photos, dB; or one of which less is better: LPIPS in them by VGG, as
    the paper's is, fill, milliseconds of a frame."""
    table: int = 1
    """Number of the paper's table that has both rows."""
    share: float = FEW

    def difference(self, cells: dict[str, Row], scene: str) -> float | None:
        """How much better: dB, or percent of the other's LPIPS, fill or time; None if a row lacks
        this scene."""
        ours = self._value(cells.get(cell_key(scene, self.better, self.share)))
        theirs = [
            value
            for way in self.than
            if (value := self._value(cells.get(cell_key(scene, way, self.share)))) is not None
        ]
        if ours is None or len(theirs) < len(self.than):
            return None
        return self._better_by(ours, theirs)

    def _better_by(self, ours: float, theirs: Sequence[float]) -> float:
        if self.measure == "psnr":
            return ours - max(theirs)
        return 100 * (1 - ours / min(theirs))

    def _value(self, cell: Row | None) -> float | None:
        if cell is None:
            return None
        point = cell["point"]
        if self.measure in PUBLISHED_METRICS:
            return (point["against_photos"] or point["against_dense"]).get(self.measure)
        return point.get(self.measure)

    def of_paper(self) -> dict[str, float]:
        """The same difference of the paper's PSNR, dB, or LPIPS, percent, by dataset; of other
        measures none."""
        found = {}
        for dataset in PROTOCOL.datasets if self.measure in PUBLISHED_METRICS else ():
            rows = [
                published(self.table, dataset, way.name, self.share)
                for way in (self.better, *self.than)
            ]
            values = [
                dict(zip(PUBLISHED_METRICS, row, strict=True))[self.measure]
                for row in rows
                if row is not None
            ]
            if len(values) == len(rows):
                found[dataset] = self._better_by(values[0], values[1:])
        return found


_DUAL, _DUAL_OWN = WAYS.pointsplat.protocols
_CONCAT, _CONCAT_OWN = WAYS.paper_splatformer.protocols
_RANDOM, _ = WAYS.splatformer.protocols
_PAPER = WAYS.paper
_OTHER_LAMBDAS = tuple(
    way for _, way in WAYS.table_3 if way.network is None and way.name != _PAPER.name
)
_TABLE_4 = {way.name: way for way in WAYS.table_4}

CLAIMS = (
    Claim("refining improves the selection in scenes that the network never saw", _DUAL, (_PAPER,)),
    Claim(
        "refining improves the selection where the network was trained on the scenes' own photos",
        _DUAL_OWN,
        (_PAPER,),
    ),
    Claim(
        "refining lowers LPIPS by VGG in scenes that the network never saw",
        _DUAL,
        (_PAPER,),
        "lpips_vgg",
    ),
    Claim(
        "selecting by the score beats selecting at random, each refined by a concat network",
        _CONCAT,
        (_RANDOM,),
    ),
    Claim("the dual-branch encoder beats the concatenating one, unseen", _DUAL, (_CONCAT,)),
    Claim(
        "the dual-branch encoder beats the concatenating one, own photos",
        _DUAL_OWN,
        (_CONCAT_OWN,),
    ),
    Claim(
        "the position encoding helps (III above II), unseen",
        _TABLE_4["pointsplat-iii"],
        (_TABLE_4["pointsplat-ii"],),
        table=4,
    ),
    Claim(
        "the appearance branch helps (V above III), unseen",
        _DUAL,
        (_TABLE_4["pointsplat-iii"],),
        table=4,
    ),
    Claim("lambda 0.3 selects better than 0.1, 0.5, 0.7 and 0.9", _PAPER, _OTHER_LAMBDAS, table=3),
    Claim(
        "PointSplat, unseen, reaches what LightGaussian keeps without fine-tuning",
        _DUAL,
        (WAYS.lightgaussian,),
    ),
    Claim(
        "refining a selection does not raise its fill",
        _DUAL,
        (_PAPER,),
        "fill",
    ),
    Claim(
        "PointSplat, unseen, draws fewer Gaussians per pixel than fine-tuned LightGaussian",
        _DUAL,
        (WAYS.lightgaussian_tuned,),
        "fill",
    ),
    Claim(
        "PointSplat, unseen, draws fewer Gaussians per pixel than fine-tuned PUP-3DGS",
        _DUAL,
        (WAYS.pup_tuned,),
        "fill",
    ),
    Claim(
        "PointSplat, unseen, is drawn faster than fine-tuned LightGaussian, on this CPU",
        _DUAL,
        (WAYS.lightgaussian_tuned,),
        "frame_ms",
    ),
)
"""What the paper says of its rows (Quantitative Results, Efficiency, Choosing Gaussians, Ablation
study)."""

OURS = (
    Claim("merging keeps more than PointSplat, unseen", WAYS.merge, (_DUAL,)),
    Claim("merging keeps more than PointSplat, own photos", WAYS.merge, (_DUAL_OWN,)),
    Claim(
        "merging keeps more than LightGaussian and PUP-3DGS without fine-tuning",
        WAYS.merge,
        (WAYS.lightgaussian, WAYS.pup),
    ),
    Claim(
        "compact, without photos, keeps more than LightGaussian and PUP-3DGS fine-tuned on them",
        WAYS.compact,
        (WAYS.lightgaussian_tuned, WAYS.pup_tuned),
    ),
)
"""What the rows of this package add."""


@dataclass(frozen=True)
class Outcome:
    """A claim on some scenes."""

    claim: Claim
    differences: tuple[float, ...]
    """Of each scene that both rows have, in the claim's unit."""

    @property
    def mean(self) -> float:
        return fmean(self.differences)

    @property
    def spread(self) -> float:
        """Standard deviation over scenes; 0 for one."""
        return stdev(self.differences) if len(self.differences) > 1 else 0.0

    @property
    def verdict(self) -> Verdict:
        """A claim holds if the mean difference is larger than its spread; it fails if it is below
        the negative of that."""
        if not self.differences:
            return Verdict.UNKNOWN
        if abs(self.mean) <= self.spread:
            return Verdict.OPEN
        return Verdict.HOLDS if self.mean > 0 else Verdict.FAILS

    def text(self) -> str:
        """The claim with its figures.

        Example:
            >>> Outcome(CLAIMS[0], (1.0, 2.0)).text()
            'refining improves the selection in scenes that the network never saw (+1.5 ± 0.7 dB; \
paper: +1.6 on ScanNet++, +12.2 on Replica)'
        """
        words = self.claim.text
        if not self.differences:
            return words
        unit, digits = ("dB", 1) if self.claim.measure == "psnr" else ("%", 0)
        figures = f"{self.mean:+.{digits}f} ± {self.spread:.{digits}f} {unit}"
        theirs = ", ".join(
            f"{value:+.{digits}f} on {name}" for name, value in self.claim.of_paper().items()
        )
        return f"{words} ({figures}{f'; paper: {theirs}' if theirs else ''})"


def outcomes(
    claims: Iterable[Claim], cells: dict[str, Row], scenes: Sequence[str]
) -> list[Outcome]:
    """All claims on these scenes."""
    found = []
    for claim in claims:
        differences = (claim.difference(cells, scene) for scene in scenes)
        found.append(Outcome(claim, tuple(value for value in differences if value is not None)))
    return found


def paragraph(claims: Sequence[Claim], cells: dict[str, Row], scenes: Sequence[str]) -> str:
    """Sentences on all claims, by verdict: what holds first."""
    return sentences(outcomes(claims, cells, scenes))


def sentences(found: Sequence[Outcome]) -> str:
    """A sentence for each verdict, on the claims that have it: what holds first."""
    parts = []
    for verdict in Verdict:
        texts = [outcome.text() for outcome in found if outcome.verdict is verdict]
        if texts:
            parts.append(f"What {verdict.value}: {'; '.join(texts)}.")
    return " ".join(parts)
