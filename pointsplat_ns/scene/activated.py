"""Recognises PLYs whose scales and opacities are activated: deviations instead of their logarithms,
opacities instead of logits.

Some programs write them so, mostly by mistake. Such a file read as it stands has Gaussians of at
least one scene unit that are half transparent. No header tells it, so the values have to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FEWEST = 32
"""Minimum number of Gaussians to tell from: chance explains less than 1e-9 of such logits."""

LEAST_SPREAD = 0.05
"""Minimum range of opacities to tell from. A program may give one logit to all Gaussians."""

DENSEST = 1000.0
"""Number of Gaussians behind one another, on average over the content, that no scene has."""


class Activated(NamedTuple):
    """Parameters of a file that are stored activated."""

    scales: bool = False
    opacities: bool = False

    def __str__(self) -> str:
        """The names of the parameters."""
        return " and ".join(name for name, stored in self._asdict().items() if stored)


def activated_in(
    means: NDArray[np.float64],
    scales: NDArray[np.float64],
    opacities: NDArray[np.float64],
    count: int,
) -> Activated:
    """The parameters that are stored activated, from a sample of a file's rows.

    Opacities are, if all are in [0, 1] and not all are the same: as logits, none would be below 0.5
    or above 0.74, and every trained scene has both. Scales are, if none is below 0 and either the
    opacities are in [0, 1], too, or as logarithms they would give more than :data:`DENSEST`
    Gaussians behind one another, and as deviations fewer.

    Args:
        means: (N, 3) positions.
        scales: (N, 2) or (N, 3) scales as stored.
        opacities: (N,) opacities as stored.
        count: number of Gaussians in the file.
    """
    table = np.column_stack([means, scales, opacities])
    finite = np.isfinite(table).all(axis=1)
    if finite.sum() < FEWEST:
        return Activated()
    means, scales, opacities = means[finite], scales[finite], opacities[finite]
    in_range = bool(((opacities >= 0) & (opacities <= 1)).all())
    positive = bool((scales >= 0).all()) and float(np.median(scales)) > 0
    as_logs = _density(means, np.exp(np.minimum(scales, 300.0)), count)
    too_dense = as_logs > DENSEST > _density(means, scales, count)
    varied = float(np.ptp(opacities)) > LEAST_SPREAD
    return Activated(
        scales=positive and (too_dense or (in_range and varied)),
        opacities=in_range and (varied or (positive and too_dense)),
    )


def _density(means: NDArray[np.float64], stds: NDArray[np.float64], count: int) -> float:
    """Mean number of Gaussians behind one another: the area of ``count`` Gaussians with these
    standard deviations over that of the content, seen along its shortest side."""
    low, high = np.quantile(means, (0.02, 0.98), axis=0)
    content = float(np.prod(np.sort(high - low)[1:]))
    area = 2 * np.pi * float(np.prod(np.sort(stds, axis=1)[:, -2:], axis=1).mean())
    return count * area / max(content, 1e-300)
