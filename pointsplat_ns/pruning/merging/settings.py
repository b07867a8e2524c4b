"""Settings of merging.

Numbers that gain less than 0.1 dB, and bounds that keep values finite, are beside their formulas.
``lab/judge/ablation.py`` measures the gain of each setting.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MergeSettings:
    """Settings of :func:`~pointsplat_ns.pruning.merging.merge`, in the order of its steps.

    Example:
        >>> from dataclasses import replace
        >>> replace(MERGING, regrouping_rounds=0).neighbours  # the default, without regrouping
        6
    """

    min_count_rendered: int = 2_000
    """Minimum number of Gaussians for which views are sampled. A smaller scene without given views
    is merged with equal weights, without renders, in less time than sampling takes."""

    max_count_rendered: int = 2_000_000
    """Maximum number of Gaussians in the reference renders for finishing. A larger scene is
    rendered once rounds have reduced it to this number."""

    sampled_views: int = 48
    """Number of sampled views if none are given; 0 turns sampling off."""

    view_seed: int = 1
    """Seed of the sampled views."""

    visibility_views: int = 48
    """Maximum number of views for counting covered pixels. 48 gain 0.2 to 0.7 dB over 16 in a
    lounge."""

    max_count_drawn: int = 250_000
    """Maximum number of Gaussians drawn to count covered pixels; in larger scenes, every second
    (third, ...) is drawn, enlarged. In a lounge of 445,000, half or a quarter is as good as all
    (0.0 dB), and so is half in three scenes of 57,000 to 93,000 (-0.1 to 0.1 dB); in a bouquet of
    117,000, a quarter loses 0.4 dB at 10 %."""

    min_visibility: float = 1e-4
    """Lower bound of a visibility weight, relative to a clearly visible Gaussian. Above 0, because
    real cameras may stand elsewhere. 1e-2 loses 2 dB in a capture with its poses (fox, 10 %)."""

    blur: float = 1.0
    """Share of the rasterizer's blur by which Gaussians are widened while they are merged, in a
    scene of which most are narrower; 0 turns this off, and loses 4.4 to 5.4 dB in needles thinner
    than a pixel (a kettle and flowers, 10 and 30 %)."""

    neighbours: int = 6
    """Number of nearest centres considered as partners. 8 are 0.1 dB worse, 12 0.4."""

    round_share: float = 0.4
    """Maximum share of the remaining Gaussians that one round merges away. Smaller shares are
    greedier and worse in measurements: the cost of a pair ignores earlier losses of its members,
    and even thinning keeps losses small."""

    matching_passes: int = 6
    """Number of passes per round that pair the Gaussians that are still free."""

    background_decay: float = 4.0
    """Decay of the cost of holes with the cover: exp(-decay * cover)."""

    min_cover: float = 0.5
    """Lower bound of the cover, the summed opacity of all Gaussians at a place, in the denominator
    of the cost."""

    max_opacity: float = 0.999
    """Maximum opacity of a replacement. If its mass needs more, its area grows instead."""

    growth_exponent: float = 0.6
    """Exponent of the area's growth by the ratio of needed opacity to ``max_opacity``: 0 opens
    holes, 1 smears edges."""

    regrouping_rounds: int = 2
    """Number of times that members move between groups; 0 turns the step off. About 3 % would move
    in a third round."""

    regrouping_contrast: float = 0.3
    """Colour difference, root of the sum of squares over channels, equivalent to one standard
    deviation in regrouping, colour units."""

    finish_views: int = 4
    """Number of views compared in finishing; 0 turns the step off. 8 gain nothing on average and
    take an eighth longer."""


MERGING = MergeSettings()
"""The default settings."""
