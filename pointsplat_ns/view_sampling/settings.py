"""Settings of view sampling: tuned parameters with meaning and unit.

Parameters with little effect on results are in their formulas. A unit is a tenth of the diagonal of
the scene's content, see :data:`~pointsplat_ns.view_sampling.content.UNITS`.
``lab/judge/ablation.py`` measures the gain of each field.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass


@dataclass(frozen=True)
class ViewSamplingSettings:
    """Settings of :mod:`pointsplat_ns.view_sampling`."""

    field_of_view: float = 70.0
    """Field of view across a sampled view's longer side, degrees: a phone's main camera."""

    # Traces of photos (traces.py)

    trace_neighbourhood: int = 129
    """Number of Gaussians along a space-filling curve for averaging traces, odd. A single Gaussian
    is weak evidence."""

    energy_exponent: float = 0.75
    """Exponent of the mean SH energy in a trace factor; 0 turns it off. Fitted, together with the
    next, to the poses of four captures."""

    flatness_exponent: float = 1.0
    """Exponent of the mean flatness in a trace factor; 0 turns it off."""

    max_log_factor: float = 8.0
    """Bound of the absolute value of a trace factor's logarithm; 0 turns trace factors off. Without
    them six captures lose 0.1 to 0.2 dB on average at 10 %, two of them 0.4 to 0.5, and one gains
    0.2."""

    evidence_count: int = 1_500
    """Maximum number of Gaussians whose SH are compared with candidate places."""

    photo_share_exponent: float = 8
    """Exponent of a place's evidence in its share."""

    min_sh_evidence: float = 2.0
    """Minimum SH evidence of the best place, explained energy relative to SH of random directions,
    for trace factors to apply; infinity turns them off. Captures reach 3.3 to 3.7 at photo places.
    Scenes photographed from all around reach 1.2 to 1.6, and their best places are in wrong parts
    of them (-0.1 to -0.4 dB). Without SH, trace factors never apply: by flatness alone they cost a
    garden 0.7 to 1.0 dB, and gained a capture 0.4."""

    min_size_evidence: float = 0.48
    """The same for scenes without SH, by the correlation of the logarithms of size and distance,
    for the scene to be a capture (:func:`~pointsplat_ns.view_sampling.upright.upright_axis`).
    Outdoor captures reach 0.50 to 0.78; rooms, where any free place fits, 0.23 to 0.46."""

    # Up (upright.py)

    usual_axis_factors: tuple[float, float, float] = (1.32, 1.65, 1.32)
    """Factors of the uprightness of the world axes: most files are aligned with one, and most have
    -y up. (0, 0, 0) turns the rule off. 18 files and the example room, rotated to each of six up
    directions, get the right axis in 100 of 114 cases. With 1.32 for y, two rooms whose walls are
    as flat as their floors are always wrong, also unrotated, and all others right."""

    min_seen_from_above: float = 0.25
    """Minimum absolute logarithm of the ratio of the Gaussians visible from above to those visible
    from below, to decide between both; infinity turns the rule off. People photograph from above,
    and floors hide content below them. The rule is right in all of 27 captures and splats, most
    narrowly for a robot over a meadow (0.106), and wrong in a closed synthetic room (0.23)."""

    min_seen_from_below: float = 0.4
    """Minimum logarithm of the ratio of the Gaussians visible from below to those visible from
    above, to doubt a declared up direction; infinity turns the doubt off. 18 splats and the example
    room in their true directions have at most 0.03; 12 of them upside down have more than this.
    In a closed synthetic room it was 0.23."""

    min_other_uprightness: float = 0.3
    """Minimum uprightness of another axis, to doubt a declared one."""

    max_declared_uprightness: float = 0.5
    """Maximum uprightness of a declared axis, as a share of the best one's, to doubt it; 0 turns
    the doubt off. True axes have at least 0.8."""

    # Views (sampler.py)

    sampled_count: int = 250_000
    """Approximate maximum number of Gaussians for view sampling; in larger scenes, every second
    (third, ...) is used."""

    min_opacity: float = 0.1
    """Minimum opacity of targets and of the Gaussians compared with candidate places, if there are
    any, because haze hides nothing; 0 turns the rule off."""

    candidate_gaussians: int = 10_000
    """Approximate maximum number of Gaussians in the images of candidates."""

    candidate_side: int = 64
    """Longer side of these images, pixels."""

    candidates_per_view: int = 8
    """Number of candidates per view."""

    min_candidates: int = 64
    """Minimum number of candidates."""

    room_enclosure: float = 0.75
    """Minimum mean enclosure of photos, by the likelihoods of candidates, for the scene to be a
    closed room, which is not seen from beyond its walls; infinity turns the rule off. Ten rooms
    reach 0.79 to 0.98, half a room 0.55, objects and a garden 0.13 to 0.22."""

    half_gain_coverage: float = 0.5
    """Number of views showing a Gaussian at which another view counts half."""

    apparent_sizes: tuple[float, float] = (0.0015, 0.0175)
    """Angles that the Gaussians around the target subtend, radians: 2 to 24 pixels of 1920."""

    likely_share_exponent: float = 0.5
    """Exponent of a candidate's likelihood in its share of the candidates of the second half. With
    1, most views of a bathroom are from one of its corners."""

    place_deviation: float = 0.15
    """Standard deviation of candidates from photo places and from likely candidates along each
    axis, units."""


DEFAULT_SETTINGS = ViewSamplingSettings()
"""The default settings."""

_in_use: ContextVar[ViewSamplingSettings] = ContextVar(
    "view_sampling_settings", default=DEFAULT_SETTINGS
)


def current_settings() -> ViewSamplingSettings:
    """The settings of the innermost :func:`use_settings`; by default :data:`DEFAULT_SETTINGS`."""
    return _in_use.get()


@contextmanager
def use_settings(settings: ViewSamplingSettings) -> Iterator[None]:
    """Use other settings inside of the context, for measurements and tests. Threads started
    elsewhere and other processes are not affected."""
    token = _in_use.set(settings)
    try:
        yield
    finally:
        _in_use.reset(token)
