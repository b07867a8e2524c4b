"""Variants of the default settings: for each rule the value that turns it off, or a value beside the default.

A new variant is one line in :data:`MERGING` or :data:`LOOKING`: its name, and the fields that it changes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from pointsplat_ns.looking import settings as looking
from pointsplat_ns.pruning.merging import settings as merging

BASELINE = "default"
"""Name of the settings that all variants are compared with."""


MERGING = {
    "no_renders": dict(min_count_rendered=10**9),
    "reference_20k": dict(max_count_rendered=20_000),
    "sampled_views_24": dict(sampled_views=24),
    "other_views": dict(view_seed=2),
    "visibility_views_16": dict(visibility_views=16),
    "visibility_side_56": dict(visibility_side=56),
    "visibility_side_224": dict(visibility_side=224),
    "drawn_100k": dict(max_count_drawn=100_000),
    "well_seen_0.98": dict(well_seen_quantile=0.98),
    "equal_weights": dict(min_visibility=1.0),
    "min_visibility_1e-2": dict(min_visibility=1e-2),
    "neighbours_4": dict(neighbours=4),
    "neighbours_8": dict(neighbours=8),
    "round_share_0.3": dict(round_share=0.3),
    "round_share_0.5": dict(round_share=0.5),
    "matching_passes_3": dict(matching_passes=3),
    "colour_axes_3": dict(colour_axes=3),
    "no_max_colour": dict(max_colour=1e6),
    "min_contrast_0.001": dict(min_contrast=0.001),
    "min_contrast_0.05": dict(min_contrast=0.05),
    "no_background": dict(background_contrast=0.0),
    "background_decay_1": dict(background_decay=1.0),
    "min_cover_0.1": dict(min_cover=0.1),
    "max_opacity_0.99": dict(max_opacity=0.99),
    "growth_0": dict(growth_exponent=0.0),
    "growth_1": dict(growth_exponent=1.0),
    "no_max_growth": dict(max_growth_ratio=1e9),
    "no_regrouping": dict(regrouping_rounds=0),
    "regrouping_once": dict(regrouping_rounds=1),
    "regrouping_candidates_3": dict(regrouping_candidates=3),
    "no_regrouping_contrast": dict(regrouping_contrast=1e6),
    "no_finish": dict(finish_views=0),
    "finish_views_8": dict(finish_views=8),
    "no_depth": dict(depth_exponent=0.0),
    "wide_size_changes": dict(size_changes=(-0.2, 0.0, 0.1)),
    "no_size_change_margin": dict(size_change_margin=0.0),
}
"""Variants of :class:`~pointsplat_ns.pruning.merging.MergeSettings`, which ``merge`` is given."""

LOOKING = {
    "all_positions": dict(outlier_quantiles=(0.0, 1.0)),
    "no_max_area": dict(max_area_quantile=1.0),
    "trace_neighbourhood_33": dict(trace_neighbourhood=33),
    "no_energy": dict(energy_exponent=0.0),
    "no_flatness": dict(flatness_exponent=0.0),
    "no_flatness_without_sh": dict(flatness_exponent_without_sh=0.0),
    "no_trace_factors": dict(max_log_factor=0.0),
    "evidence_count_500": dict(evidence_count=500),
    "no_sh_evidence": dict(min_sh_evidence=1e9),
    "no_size_evidence": dict(min_size_evidence=1e9),
    "no_min_opacity": dict(min_opacity=0.0),
    "surface_exponent_0": dict(surface_exponent=0.0),
    "surface_exponent_1": dict(surface_exponent=1.0),
    "no_usual_axes": dict(usual_axis_factors=(0.0, 0.0)),
    "no_photo_directions": dict(photo_direction_weight=0.0),
    "no_seen_from_above": dict(min_seen_from_above=float("inf")),
    "places_evenly": dict(photo_share_exponent=0.0),
    "photo_place_deviation_0.4": dict(photo_place_deviation=0.4),
    "candidates_4": dict(candidates_per_view=4),
    "candidates_16": dict(candidates_per_view=16),
    "candidate_gaussians_4k": dict(candidate_gaussians=4_000),
    "any_pitch": dict(pitches=(-90.0, 90.0), aims=1),
    "half_gain_coverage_1": dict(half_gain_coverage=1.0),
    "smallest_side_160": dict(smallest_side=160),
}
"""Variants of :class:`~pointsplat_ns.looking.settings.LookingSettings`, which are in force while ``merge`` runs."""


@dataclasses.dataclass(frozen=True)
class Table:
    """The variants of one settings object."""

    title: str
    defaults: Any  # a frozen dataclass
    variants: dict[str, dict[str, Any]]


TABLES = {
    "merging": Table("Merging", merging.MERGING, MERGING),
    "looking": Table("Looking", looking.LOOKING, LOOKING),
}
"""All variants. Names differ between tables."""


def names() -> list[str]:
    """Names of all variants."""
    return [name for table in TABLES.values() for name in table.variants]


def table_of(name: str) -> str:
    """The key in :data:`TABLES` of the table that has a variant."""
    return next(key for key, table in TABLES.items() if name in table.variants)


def changes_of(name: str) -> dict[str, Any]:
    """The changes of a variant as JSON has them: none for :data:`BASELINE`."""
    if name == BASELINE:
        return {}
    return json.loads(json.dumps(TABLES[table_of(name)].variants[name]))


def default_values() -> dict[str, Any]:
    """The default of each field of each table, as JSON has them, by ``table.field``."""
    values = {f"{key}.{field}": value for key, t in TABLES.items() for field, value in vars(t.defaults).items()}
    return json.loads(json.dumps(values))


def check(chosen: Iterable[str]) -> None:
    """Check that variants exist.

    Raises:
        SystemExit: if there is none of a name.
    """
    if unknown := [name for name in chosen if name not in names()]:
        raise SystemExit(f"--variants {' '.join(unknown)}; expected some of: {', '.join(names())}")


@contextmanager
def applied(name: str) -> Iterator[merging.MergeSettings]:
    """Settings of merging for a variant or for :data:`BASELINE`. A variant of another table is in force while the
    context is open."""
    if name == BASELINE:
        yield merging.MERGING
        return
    key = table_of(name)
    changes = TABLES[key].variants[name]
    if key == "merging":
        yield dataclasses.replace(merging.MERGING, **changes)
        return
    with replaced(TABLES[key].defaults, changes):
        yield merging.MERGING


@contextmanager
def replaced(defaults: Any, changes: dict[str, Any]) -> Iterator[None]:
    """Other values for fields of a frozen settings object while the context is open. The object itself changes, because
    default arguments hold it, too.

    Raises:
        TypeError: if the object has no field of a name.
    """
    before = {field: getattr(defaults, field) for field in vars(dataclasses.replace(defaults, **changes))}
    try:
        for field, value in changes.items():
            object.__setattr__(defaults, field, value)
        yield
    finally:
        for field in changes:
            object.__setattr__(defaults, field, before[field])
