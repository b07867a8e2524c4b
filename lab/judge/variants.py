"""Variants of the default settings: for each rule the value that turns it off, or a value beside the default.

A new variant is one line in :data:`MERGING` or :data:`LOOKING`. If it changes one field, the page takes what the rule
does from the docstring of that field; if it changes several, or if the change says more than the field does, it needs a
label.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from pointsplat_ns.looking import settings as looking
from pointsplat_ns.pruning.merging import settings as merging

BASELINE = "default"
"""Name of the settings that all variants are compared with."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """Settings that differ from the defaults."""

    changes: dict[str, Any]
    label: str


def variant(label: str = "", **changes: Any) -> Variant:
    """A variant by the fields that it changes."""
    return Variant(changes, label)


MERGING = {
    "no_renders": variant("Equal weights and no finish where no views are given.", min_count_rendered=10**9),
    "reference_20k": variant(max_count_rendered=20_000),
    "sampled_views_48": variant(sampled_views=48),
    "other_views": variant("Other sampled views. What this changes is chance.", view_seed=2),
    "no_photo_places": variant(find_photo_places=False),
    "visibility_views_16": variant(visibility_views=16),
    "visibility_side_56": variant(visibility_side=56),
    "visibility_side_224": variant(visibility_side=224),
    "drawn_100k": variant(max_count_drawn=100_000),
    "well_seen_0.98": variant(well_seen_quantile=0.98),
    "equal_weights": variant("Equal visibility of all Gaussians. What photos showed still counts.", min_visibility=1.0),
    "min_visibility_1e-2": variant(min_visibility=1e-2),
    "neighbours_4": variant(neighbours=4),
    "neighbours_8": variant(neighbours=8),
    "round_share_0.3": variant(round_share=0.3),
    "round_share_0.5": variant(round_share=0.5),
    "matching_passes_3": variant(matching_passes=3),
    "colour_axes_3": variant(colour_axes=3),
    "no_max_colour": variant(max_colour=1e6),
    "min_contrast_0.001": variant(min_contrast=0.001),
    "min_contrast_0.05": variant(min_contrast=0.05),
    "no_background": variant(background_contrast=0.0),
    "background_decay_1": variant(background_decay=1.0),
    "min_cover_0.1": variant(min_cover=0.1),
    "max_opacity_0.99": variant(max_opacity=0.99),
    "growth_0": variant(growth_exponent=0.0),
    "growth_1": variant(growth_exponent=1.0),
    "no_max_growth": variant(max_growth_ratio=1e9),
    "no_regrouping": variant(regrouping_rounds=0),
    "regrouping_once": variant(regrouping_rounds=1),
    "regrouping_candidates_3": variant(regrouping_candidates=3),
    "no_regrouping_contrast": variant("Regrouping does not compare colours.", regrouping_contrast=1e6),
    "no_finish": variant("Sizes of merged Gaussians are not chosen by renders.", finish_views=0),
    "finish_views_8": variant(finish_views=8),
    "no_depth": variant(depth_exponent=0.0),
    "wide_size_changes": variant(size_changes=(-0.2, 0.0, 0.1)),
    "no_size_change_margin": variant(size_change_margin=0.0),
}
"""Variants of :class:`~pointsplat_ns.pruning.merging.MergeSettings`, which ``merge`` is given."""

LOOKING = {
    "all_positions": variant(outlier_quantiles=(0.0, 1.0)),
    "no_max_area": variant(max_area_quantile=1.0),
    "trace_neighbourhood_33": variant(trace_neighbourhood=33),
    "no_energy": variant(energy_exponent=0.0),
    "no_flatness": variant(flatness_exponent=0.0),
    "no_flatness_without_sh": variant(flatness_exponent_without_sh=0.0),
    "no_trace_factors": variant("What photos showed does not count.", max_log_factor=0.0),
    "evidence_count_500": variant(evidence_count=500),
    "first_places_all": variant(promising_share=0.0),
    "no_sh_evidence": variant(min_sh_evidence=1e9),
    "sh_share_exponent_4": variant(sh_share_exponent=4.0),
    "no_size_evidence": variant(min_size_evidence=1e9),
    "size_share_exponent_2": variant(size_share_exponent=2.0),
    "no_min_surface_opacity": variant(min_surface_opacity=0.0),
    "surface_exponent_0": variant(surface_exponent=0.0),
    "surface_exponent_1": variant(surface_exponent=1.0),
    "no_min_uprightness": variant(min_uprightness=0.0),
    "no_usual_axes": variant(usual_axis_factors=(0.0, 0.0)),
    "no_usual_axes_with_photos": variant(
        "World axes are not preferred as up where photo places are known.", usual_axis_factors_with_photos=(0.0, 0.0)
    ),
    "no_photo_level": variant(photo_level_weight=0.0),
    "no_seen_from_above": variant(min_seen_from_above=float("inf")),
    "no_min_box": variant(min_box_half_side=0.0),
    "never_a_room": variant("No scene counts as a room.", min_enclosed_places=2.0),
    "places_24": variant(places=24),
    "any_eye_height": variant(eye_heights=(0.0, 1.0)),
    "level_views": variant("Views in rooms look level.", pitch_mean=0.0, pitch_deviation=0.0),
    "target_centre": variant(target_share=0.0),
    "no_photo_views": variant(photo_share=0.0),
    "photo_views_only": variant(photo_share=1.0),
    "photo_place_deviation_0.2": variant(photo_place_deviation=0.2),
    "no_photo_target_distance": variant(photo_target_distance=1e9),
    "no_min_photo_value": variant(min_photo_value=0.0),
    "no_half_gain_distance": variant(half_gain_distance=1e9),
    "no_half_gain_angle": variant(half_gain_angle=1e9),
    "half_gain_coverage_1": variant(half_gain_coverage=1.0),
    "no_clearance": variant("Cameras may stand in surfaces.", min_clearance=0.0, min_clearance_photos=0.0),
    "no_max_near_pixels": variant(max_near_pixels=2.0),
    "no_min_alpha_inside": variant(min_alpha_inside=0.0),
    "no_min_alpha_outside": variant(min_alpha_outside=0.0),
    "window_side_160": variant(window_side=160),
}
"""Variants of :class:`~pointsplat_ns.looking.settings.LookingSettings`, which are in force while ``merge`` runs.
Merging does not test views for blur, so there are no variants of blur."""


@dataclasses.dataclass(frozen=True)
class Table:
    """The variants of one settings object."""

    title: str
    defaults: Any  # a frozen dataclass
    variants: dict[str, Variant]


TABLES = {
    "merging": Table("Merging", merging.DEFAULTS, MERGING),
    "looking": Table("Looking", looking.DEFAULTS, LOOKING),
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
    return json.loads(json.dumps(TABLES[table_of(name)].variants[name].changes))


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
        yield merging.DEFAULTS
        return
    key = table_of(name)
    changes = TABLES[key].variants[name].changes
    if key == "merging":
        yield dataclasses.replace(merging.DEFAULTS, **changes)
        return
    with replaced(TABLES[key].defaults, changes):
        yield merging.DEFAULTS


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


def sentence_of(name: str) -> str:
    """What the changed rule does, in one sentence: the label of a variant, else the beginning of its field's
    docstring."""
    table = TABLES[table_of(name)]
    found = table.variants[name]
    if found.label:
        return found.label
    [field] = found.changes
    return first_sentence(field_docstrings(type(table.defaults))[field])


@cache
def field_docstrings(settings: type) -> dict[str, str]:
    """The string under each field of a dataclass, on one line, by the name of the field."""
    [definition] = ast.parse(textwrap.dedent(inspect.getsource(settings))).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, text in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = " ".join(ast.literal_eval(text.value).split())
    return found


def first_sentence(docstring: str) -> str:
    """The first sentence of a docstring, for Markdown.

    >>> first_sentence("Largest number of :class:`~a.b.Views` that ``merge`` takes, 1e-3 s each. 48 are best.")
    'Largest number of `Views` that `merge` takes, 1e-3 s each.'
    """
    sentence = re.split(r"(?<=\.)\s+(?=[A-Z0-9`])", docstring, maxsplit=1)[0]
    return re.sub(r":\w+:`(?:~[\w.]*?)?(\w+)`", r"`\1`", sentence).replace("``", "`")
