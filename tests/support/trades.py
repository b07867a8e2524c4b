"""Trades that are known in advance: scenes that are not made but calculated."""

import math
from bisect import bisect_left
from dataclasses import dataclass, field

from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.tradeoff.points import DENSE, ImageMetrics, Point, Setting


def point(
    setting: Setting, psnr: float, ms: float = 10.0, photos: float | None = None, of: int = 100_000, key: str = ""
) -> Point:
    """A point with a PSNR against the dense scene and, if given, against photos."""
    dense, name = setting.by == DENSE, f"{100 * setting.count / of:g} %, SH {setting.sh_degree}, {setting.repair}"
    return Point(
        key=key or (DENSE if dense else name),
        label=DENSE if dense else name,
        command="" if dense else f"make {name}",
        by=setting.by,
        share=setting.count / of,
        gaussians=setting.count,
        sh_degree=setting.sh_degree,
        repair=setting.repair,
        bytes=ply_bytes(setting.count, setting.sh_degree),
        against_dense=ImageMetrics(psnr, 0.9),
        against_photos=None if photos is None else ImageMetrics(photos, 0.8, 0.2),
        frame_ms=ms,
        frame_ms_low=0.9 * ms,
        frame_ms_high=1.2 * ms,
        seconds=0.0 if dense else 3.0,
    )


@dataclass
class Trade:
    """A scene whose PSNR against the dense one is a straight line over the logarithm of the count, down to which SH
    bands left out add errors of their own."""

    count: int = 100_000
    sh_degree: int = 3
    slope: float = 4.0
    """dB for each doubling of the count."""
    at_all: float = 45.0
    """PSNR of merging to nearly all, dB."""
    gains: dict[str, float] = field(default_factory=lambda: {"quick": 2.0})
    """dB that repairs bring."""
    cuts: dict[int, float] = field(default_factory=lambda: {0: 28.0, 1: 31.0, 2: 35.0})
    """PSNR of the dense scene without higher SH bands, dB."""
    asked: list[Setting] = field(default_factory=list)
    """What was measured, in order."""

    @property
    def dense(self) -> Point:
        return point(Setting(self.count, self.sh_degree, by=DENSE), math.inf, self.ms(self.count), of=self.count)

    def ms(self, count: int) -> float:
        return 1.0 + count / 1000

    def psnr(self, setting: Setting) -> float:
        merged = self.at_all + self.slope * math.log2(setting.count / self.count) + self.gains.get(setting.repair, 0.0)
        errors = [10 ** (-merged / 10)]
        errors += [10 ** (-self.cut(setting.sh_degree) / 10)] if setting.sh_degree < self.sh_degree else []
        return -10 * math.log10(sum(errors))

    def cut(self, degree: int) -> float:
        return self.cuts[degree]

    def measure(self, setting: Setting) -> Point:
        self.asked.append(setting)
        return point(setting, self.psnr(setting), self.ms(setting.count), of=self.count)

    def smallest(self, psnr: float) -> int:
        """Size of the smallest file that reaches a PSNR, bytes: of each SH degree and repair by bisection."""
        sizes = []
        for degree in range(self.sh_degree + 1):
            for repair in ("none", *self.gains):
                if self.psnr(Setting(self.count, degree, repair)) >= psnr:
                    counts = range(1, self.count + 1)
                    enough = bisect_left(counts, True, key=lambda n: self.psnr(Setting(n, degree, repair)) >= psnr)  # noqa: B023
                    sizes.append(ply_bytes(counts[enough], degree))
        return min(sizes)
