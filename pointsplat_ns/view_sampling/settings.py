"""The settings of looking: tuned numbers that results depend on, with their meaning and their unit.

Numbers that results hardly depend on stand in their formula. A unit is a tenth of the diagonal of
the scene's content, see :data:`~pointsplat_ns.view_sampling.content.UNITS`.
``lab/judge/ablation.py`` measures what fields are worth.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class LookingSettings:
    """Settings of :mod:`pointsplat_ns.view_sampling`."""

    field_of_view: float = 70.0
    """Field of view across the longer side of a sampled view, degrees: that of a phone's main
    camera."""

    # Traces of photos (traces.py)

    trace_neighbourhood: int = 129
    """Number of Gaussians along a space-filling curve over which traces are averaged, odd. One
    Gaussian says little."""

    energy_exponent: float = 0.75
    """Exponent of the mean energy of the SH in a trace factor; 0 turns it off. Fitted, with the
    next, to the poses of four captures."""

    flatness_exponent: float = 1.0
    """Exponent of the mean flatness in a trace factor; 0 turns it off."""

    max_log_factor: float = 8.0
    """Bound of the absolute value of the logarithm of a trace factor; 0 turns trace factors off.
    Without them six captures lose 0.1 to 0.2 dB on average at 10 %, two of them 0.4 to 0.5, and one
    gains 0.2."""

    evidence_count: int = 1_500
    """Largest number of Gaussians whose SH are compared with candidate places."""

    photo_share_exponent: float = 8
    """Exponent of the evidence of a place in its share."""

    min_sh_evidence: float = 2.0
    """Smallest evidence of the best place by SH, explained energy relative to SH of random
    directions, for trace factors to count; infinity turns them off. Captures reach 3.3 to 3.7 at
    photo places. Scenes seen from all around reach 1.2 to 1.6, and their best places lie in wrong
    parts of them (-0.1 to -0.4 dB). Without SH trace factors never count: by flatness alone they
    cost a garden 0.7 to 1.0 dB, and gained a capture 0.4."""

    min_size_evidence: float = 0.48
    """The same in scenes without SH, by the correlation of the logarithms of size and distance, for
    the scene to be a capture (:func:`~pointsplat_ns.view_sampling.upright.upright_axis`). Captures
    from outside reach 0.50 to 0.78, rooms, where any free place will do, 0.23 to 0.46."""

    # Up (upright.py)

    usual_axis_factors: tuple[float, float, float] = (1.32, 1.65, 1.32)
    """Factors of the uprightness of the world's axes: most files stand along one, and most have -y
    up. (0, 0, 0) turns the rule off. 18 files and the example room, turned so that up lies on each
    of six directions, stand along the right axis in 100 cases of 114. With 1.32 for y, two rooms
    whose walls are as flat as their floors are always wrong, also as they come, and all others
    right."""

    min_seen_from_above: float = 0.25
    """Smallest absolute value of the logarithm of the ratio of the Gaussians that are seen from
    above to those that are seen from below, for it to decide; infinity turns the rule off. People
    photograph from above, and floors hide what is below them. It is right in all of 27 captures and
    splats, most narrowly for a robot over a meadow (0.106), and wrong in a closed synthetic room
    (0.23)."""

    # Views (sampling.py)

    sampled_count: int = 250_000
    """About the largest number of Gaussians in which views are looked for; of more, every second
    (third, ...) is."""

    min_opacity: float = 0.1
    """Smallest opacity of the Gaussians that are looked at and compared with candidate places, if
    there are any: a haze hides nothing; 0 turns the rule off."""

    candidate_gaussians: int = 10_000
    """About the largest number of Gaussians in the pictures of candidates."""

    candidate_side: int = 64
    """Longer side of these pictures, pixels."""

    candidates_per_view: int = 8
    """Number of candidates for each view."""

    min_candidates: int = 64
    """Smallest number of candidates."""

    half_gain_coverage: float = 0.5
    """Number of views that show a Gaussian at which one more counts a half."""

    apparent_sizes: tuple[float, float] = (0.0015, 0.0175)
    """Angles that the Gaussians around the one in the middle subtend, radians: 2 to 24 pixels of
    1920."""

    photo_place_deviation: float = 0.15
    """Standard deviation of candidates from photo places along each axis, units."""


SHIPPED = LookingSettings()
"""The settings that ship."""

_in_use: ContextVar[LookingSettings] = ContextVar("looking", default=SHIPPED)


def looking() -> LookingSettings:
    """The settings in use: :data:`SHIPPED`, or those of the innermost :func:`use_settings`."""
    return _in_use.get()


@contextmanager
def use_settings(settings: LookingSettings) -> Iterator[None]:
    """Use other settings while the context is open: for measurements and tests. Threads that are
    started elsewhere, and other processes, keep theirs."""
    token = _in_use.set(settings)
    try:
        yield
    finally:
        _in_use.reset(token)
