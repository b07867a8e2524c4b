"""Methods and budgets."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from making import normal_scene, same, same_bits
from pointsplat_ns.errors import BudgetError, DataError, PointSplatError, SceneError
from pointsplat_ns.pruning import (
    METHODS,
    Megabytes,
    PruneSettings,
    WithinPsnr,
    parse_keep,
    ply_bytes,
    prune,
    resolve_keep,
    score_of,
    select,
)
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.poses import look_at, views_of

SCORES = [name for name, method in METHODS.items() if method.score and not method.needs_views]

WITHOUT_VIEWS = [name for name, method in METHODS.items() if not method.needs_views]

WITH_VIEWS = [name for name, method in METHODS.items() if method.needs_views]

WITHOUT_OPACITY_WEIGHT = [name for name, method in METHODS.items() if not method.weighs_opacity]

UNKNOWN = "no method is called 'best'; expected one of merge, coverage, paper, auth"


def views() -> Views:
    """Two cameras before the origin that look at it."""
    eyes = torch.tensor([[0.0, 0.0, -6.0], [-0.5, 0.0, -6.0]], dtype=torch.float64)
    return views_of(look_at(eyes, torch.zeros_like(eyes)), 10, 9, 5.0)


def kept(scene, keep, by="paper", **options):
    """Indices of the Gaussians that pruning by a score keeps, found by their centres."""
    pruned = prune(scene, keep, by, **options)
    return (pruned.means[:, None] == scene.means).all(-1).nonzero()[:, 1]


@pytest.mark.parametrize("by", SCORES)
@pytest.mark.parametrize(("keep", "k"), [(0.3, 15), (1, 1), (1.0, 50), (37, 37)])
def test_a_score_keeps_the_k_highest_bit_for_bit_and_in_order(by, keep, k):
    scene = normal_scene(50, 1)
    scene.quats[:, 0] = -0.0
    scene.opacities[::7] = math.inf
    pruned = prune(scene, keep, by)
    indices = kept(scene, keep, by)
    scores = score_of(scene, METHODS[by])
    assert len(pruned) == k and len(indices) == k and scores.shape == (50,)
    assert (indices.diff() > 0).all()
    assert same_bits(pruned, scene[indices])
    assert scores[indices].min() >= np.delete(scores.numpy(), indices).max(initial=-math.inf)


@pytest.mark.parametrize("by", WITH_VIEWS)
def test_a_score_from_views_keeps_the_highest_also_of_lazy_views(by):
    scene = normal_scene(60, 1)
    wanted = select(METHODS[by].score(scene, views()), 18)
    assert torch.equal(kept(scene, 0.3, by, views=views()), wanted)
    assert torch.equal(select(score_of(scene, METHODS[by], views), 18), wanted)


@pytest.mark.parametrize("by", ["merge", *WITH_VIEWS])
def test_progress_rises_to_one(by):
    shares = []
    prune(normal_scene(60, 1), 0.3, by, views=views(), progress=shares.append)
    assert shares and shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
def test_a_scene_with_no_gaussian_or_none_that_can_be_drawn_is_refused(by):
    with pytest.raises(BudgetError, match="has no Gaussians"):
        prune(Gaussians.empty(), 0.5, by)
    with pytest.raises(SceneError, match="none of the 60 Gaussians can be drawn"):
        prune(normal_scene(60, 1).map(lambda value: value * math.nan), 5, by)


@pytest.mark.parametrize(
    ("by", "options", "message"),
    [
        ("best", {}, UNKNOWN),
        *(
            (by, {"views": None}, f"{by} needs views of the scene; expected views")
            for by in WITH_VIEWS
        ),
        *(
            (by, {"opacity_weight": 0.5}, f"{by} does not weigh opacity; .* one of paper, authors$")
            for by in WITHOUT_OPACITY_WEIGHT
        ),
    ],
)
def test_an_unknown_method_and_options_it_does_not_take_are_refused(by, options, message):
    with pytest.raises(PointSplatError, match=message) as caught:
        prune(normal_scene(60, 1), 0.3, by, **{"views": views(), **options})
    assert isinstance(caught.value, DataError) == ("expected views" in message)


@pytest.mark.parametrize(("keep", "count"), [(0.3, 18), (1.0, 60), (1, 1), (7, 7), (7.0, 7)])
def test_settings_prune_as_prune_does(keep, count):
    scene = normal_scene(60, 1)
    assert len(PruneSettings(keep).prune(scene)) == count
    with_options = PruneSettings(keep, "authors", opacity_weight=0.9).prune(scene)
    assert same(with_options, prune(scene, count, "authors", opacity_weight=0.9))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            ({"keep": keep}, "expected a ratio above 0 and up to 1 .* or a whole")
            for keep in (0, -1, 1.5, 7.25, math.nan)
        ),
        *(
            ({"by": by}, f"{by} needs views of the scene; expected a method that needs none")
            for by in WITH_VIEWS
        ),
        ({"by": "best"}, UNKNOWN),
        ({"opacity_weight": 0.5}, "merge does not weigh opacity; .* one of paper, authors$"),
    ],
)
def test_settings_refuse_what_fits_no_scene_and_methods_that_need_views(options, message):
    with pytest.raises(PointSplatError, match=message):
        PruneSettings(**{"keep": 0.3, **options})


@pytest.mark.parametrize(
    ("n", "keep", "k"),
    [
        (1000, 0.3, 300),
        (1000, 1.0, 1000),
        (1000, 1, 1),
        (1000, 1000, 1000),
        (3, 0.5, 2),  # a half goes up
        (100, 0.29, 29),  # 0.29 * 100 is 28.999999999999996
        (1000, 1e-9, 1),  # never nothing
        (1000, np.int64(7), 7),
        (1000, np.float32(0.5), 500),
    ],
)
def test_a_float_is_a_ratio_and_an_int_is_a_count(n, keep, k):
    result = resolve_keep(n, keep)
    assert result == k and type(result) is int


@pytest.mark.parametrize(
    ("n", "keep", "message"),
    [
        *(
            (1000, keep, f"keep is {keep!r}; expected a ratio above 0 and up to 1.0")
            for keep in (0.0, -0.1, 1.0001, math.nan, math.inf, -math.inf, b"0.5", None, True)
        ),
        *((1000, keep, f"keep is {keep} Gaussians; expected at least 1") for keep in (0, -1)),
        (1000, Megabytes(1e-6), "keep is 1e-06MB, too small for one Gaussian"),
        *((0, keep, "has no Gaussians") for keep in (1, 0.5, Megabytes(1.0))),
        (1000, WithinPsnr(35.0), "needs rendering"),
        (1000, Megabytes(1.0, ".sog"), "needs writing"),
    ],
)
def test_a_budget_that_fits_no_count_of_the_scene_is_refused(n, keep, message):
    with pytest.raises(BudgetError) as caught:
        resolve_keep(n, keep)
    assert message in str(caught.value)


@pytest.mark.parametrize("kind", [Megabytes, WithinPsnr])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_size_or_a_psnr_is_positive(kind, value):
    with pytest.raises(
        BudgetError, match="keep is .*MB; expected|the wanted PSNR is .* dB; expected a pos"
    ):
        kind(value)


@pytest.mark.parametrize(
    ("text", "keep"),
    [
        ("0.3", 0.3),
        ("30%", 0.3),
        ("1", 1),
        (" 50000 ", 50000),
        *(
            (text, 1000)
            for text in ("1e3", "1k", "1,000", "0.001M", "1000 Gaussians", "1kgaussians", "1.0e3")
        ),
        ("12kb", Megabytes(0.012)),
        ("5,000 B", Megabytes(0.005)),
        ("1.5 MB.sog", Megabytes(1.5, ".sog")),
        (" 0.5 mb ", Megabytes(0.5)),
        ("12MB.SPZ", Megabytes(12.0, ".spz")),
        ("auto", WithinPsnr(35.0)),
        ("auto:32.5dB", WithinPsnr(32.5)),
        ("auto:32.5.sog", WithinPsnr(32.5, ".sog")),
        ("auto.spz", WithinPsnr(35.0, ".spz")),
    ],
)
def test_a_typed_budget_keeps_its_kind(text, keep):
    result = parse_keep(text)
    assert result == keep and isinstance(result, type(keep))


def test_few_gaussians_of_many_are_asked_about_unless_they_are_called_so():
    for n, text, kept in (
        (5000, "10%", 500),
        (5000, "10gaussians", 10),
        (4999, "10", 10),
        (5000, "100", 100),
    ):
        assert resolve_keep(n, text) == kept
    assert resolve_keep(5000, 10) == 10
    wanted = r"keep is 10, of 5,000 Gaussians; did you mean 10%\? Write 10gaussians if you mean "
    with pytest.raises(BudgetError, match=wanted):
        resolve_keep(5000, "10")


@pytest.mark.parametrize(
    "text",
    ["", "0.5 gaussians", *"half % 1,00 0,3 0.3x MB xMB 12TB 1e999 auto: auto:x automatic".split()],
)
def test_a_typed_budget_that_is_none_is_refused(text):
    with pytest.raises(BudgetError, match="expected a ratio"):
        parse_keep(text)


@settings(max_examples=80)
@given(st.integers(1, 10**7), st.integers(0, 3), st.floats(0.002, 3000))
def test_a_size_keeps_as_many_as_fit_and_not_one_more(n, degree, megabytes):
    k = resolve_keep(n, Megabytes(megabytes), degree)
    limit = math.floor(megabytes * 1e6)
    assert 1 <= k <= n and ply_bytes(k, degree) <= limit
    assert k == n or ply_bytes(k + 1, degree) > limit


@pytest.mark.parametrize(
    ("typed", "kept"),
    [("10%", 0.1), ("0.3", 0.3), ("500", 500), ("10gaussians", 10), (0.5, 0.5), (40.0, 40)],
)
def test_a_budget_is_typed_for_a_training_as_for_the_command(typed, kept):
    settings = PruneSettings.of(typed, "paper")
    assert settings.keep == kept and isinstance(settings.keep, type(kept))


def test_a_bare_small_number_is_no_count_of_a_large_scene_and_a_size_none_of_several():
    scene = normal_scene(5000)
    with pytest.raises(BudgetError, match="did you mean 10%"):
        PruneSettings.of("10", "opacity").prune(scene)
    assert len(PruneSettings.of("10gaussians", "opacity").prune(scene)) == 10
    for keep in ("12MB", "auto:35"):
        with pytest.raises(BudgetError, match="for several scenes"):
            PruneSettings.of(keep, "paper")
    with pytest.raises(
        PointSplatError, match="lambda, the opacity weight, is 1.5; expected 0 to 1"
    ):
        PruneSettings.of("10%", "paper", 1.5)
