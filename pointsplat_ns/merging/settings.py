"""The settings of merging: every tuned number, with its meaning and its unit.

A number that only keeps float32 or float64 in range stands beside the formula that needs it. All other numbers are
here. A field says how it is turned off where it stands for a rule of its own. ``lab/judge/ablation.py`` measures each
again.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MergeSettings:
    """Settings of :func:`~pointsplat_ns.merging.merge`, in the order of its steps.

    Example:
        >>> from dataclasses import replace
        >>> replace(MERGING, regrouping_rounds=0).neighbours  # everything as by default, but no regrouping
        6
    """

    # Viewpoints (visibility.py)

    min_count_rendered: int = 2_000
    """Smallest number of Gaussians for which views are sampled. A smaller scene without given views is merged with
    equal weights, without renders, in less time than sampling takes."""

    max_count_rendered: int = 2_000_000
    """Largest number of Gaussians that are rendered as the reference of finishing. A larger scene is
    rendered as soon as rounds have made it this small."""

    sampled_views: int = 48
    """Number of views that are sampled where none are given; 0 turns sampling off."""

    view_seed: int = 1
    """Seed of the sampled views."""

    # Visibility weights (visibility.py)

    visibility_views: int = 48
    """Largest number of views in which covered pixels are counted. Over 16, 48 gain 0.2 to 0.7 dB in a lounge."""

    visibility_side: int = 112
    """Longer side of the pictures in which covered pixels are counted, pixels."""

    max_count_drawn: int = 250_000
    """Largest number of Gaussians that are drawn to count covered pixels; of more, every second (third, ...) is drawn,
    larger. In a lounge of 445,000, half or a quarter is as good as all (0.0 dB), and so is half in three scenes of
    57,000 to 93,000 (-0.1 to 0.1 dB); in a bouquet of 117,000, a quarter loses 0.4 dB at 10 %."""

    well_seen_quantile: float = 0.9
    """Quantile of covered pixels per area that counts as seen well, in [0, 1]. Bounds are relative to it."""

    min_visibility: float = 1e-4
    """Lower bound of a weight, relative to a Gaussian that is seen well. It is above 0, because real cameras may stand
    elsewhere. 1e-2 loses 2 dB in a capture with its poses (fox, 10 %)."""

    # Neighbours and pairs (rounds.py, matching.py)

    neighbours: int = 6
    """Number of nearest centres that a Gaussian may be merged with. 8 are 0.1 dB worse, 12 0.4."""

    round_share: float = 0.4
    """Largest share of the remaining Gaussians that one round merges away. Smaller shares are greedier and measured
    worse: the cost of a pair does not include earlier losses of its members, and even thinning keeps losses small."""

    matching_passes: int = 6
    """Number of passes of a round that look for pairs among the Gaussians that are still free."""

    # Cost of a pair (pair_cost.py, state.py)

    colour_axes: int = 8
    """Number of principal axes of the colours, all SH bands, on which colours are compared. They hold nearly all of the
    variance."""

    max_colour: float = 10.0
    """Bound of the absolute value of a colour coefficient in costs and in regrouping, colour units. A few broken
    colours must not hide all others."""

    min_contrast: float = 0.01
    """Contrast with the surroundings that is assumed in addition to the measured one, per channel, colour units."""

    background_contrast: float = 0.3
    """Contrast with the far background that is assumed where few Gaussians overlap, per channel, colour units; 0 turns
    the cost of holes off."""

    background_decay: float = 4.0
    """Decay of the cost of holes with the cover: exp(-decay * cover)."""

    min_cover: float = 0.5
    """Lower bound of the cover, the summed opacity of all Gaussians at a place, in the denominator of the cost."""

    # Replacement of a pair (replacement.py)

    max_opacity: float = 0.999
    """Largest opacity of a replacement. If its mass needs more, its area grows instead."""

    growth_exponent: float = 0.6
    """Exponent of the growth of the area by the ratio of needed opacity to ``max_opacity``: 0 opens holes, 1 smears
    edges."""

    max_growth_ratio: float = 4.0
    """Upper bound of that ratio. Two Gaussians seldom reach 2; for points without area it would be infinite."""

    # Regrouping (regrouping.py)

    regrouping_rounds: int = 2
    """Number of times that members change groups; 0 turns the step off. In a third round about 3 % change."""

    regrouping_candidates: int = 6
    """Number of nearest groups that a member may change to."""

    regrouping_contrast: float = 0.3
    """Difference of colour, root of the sum of squares over channels, that counts as one standard deviation, colour
    units."""

    # Finish (finishing.py)

    finish_views: int = 4
    """Number of views that are compared; 0 turns the step off. 8 gain nothing on average and take an eighth
    longer."""

    depth_exponent: float = 0.15
    """The optical depth of a merged Gaussian is multiplied by its number of members to this power: merging spreads its
    mass over a larger area, so that more of the background shows through. Choosing it for each scene gains nothing. At
    10 %, flowers gain 0.4 dB and a bouquet 0.6; three other scenes gain nothing."""

    size_changes: tuple[float, float, float] = (-0.1, 0.0, 0.05)
    """Changes of the log-scales of merged Gaussians that are tried by renders, ascending."""

    size_change_margin: float = 0.05
    """How far outside of ``size_changes`` the chosen one may lie. Flowers gain 0.4 dB where ``depth_exponent`` is 0."""


MERGING = MergeSettings()
"""The settings that scenes are merged with by default."""
