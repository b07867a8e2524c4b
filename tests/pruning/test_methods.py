"""The registry of methods, and the one way through it: exact counts, what is kept, what is refused."""

import math

import numpy as np
import pytest
import torch

from making import normal_scene, same
from pointsplat_ns.errors import BudgetError, DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import METHODS, Megabytes, PruneSettings, WithinPsnr, ply_bytes, prune, score_of, select
from pointsplat_ns.views import Views

SCORES = [name for name, method in METHODS.items() if method.score and not method.needs_views]
WITHOUT_VIEWS = [name for name, method in METHODS.items() if not method.needs_views]
WITH_VIEWS = [name for name, method in METHODS.items() if method.needs_views]
WITHOUT_OPACITY_WEIGHT = [name for name, method in METHODS.items() if not method.weighs_opacity]
UNKNOWN = "no method is called 'best'; expected one of merge, coverage, paper, auth"


def views(count: int = 2) -> Views:
    """Cameras before the origin that look at it."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    viewmats[:, 2, 3] = 6.0
    viewmats[:, 0, 3] = 0.5 * torch.arange(count)
    K = torch.tensor([[10.0, 0, 5], [0, 10, 4.5], [0, 0, 1]], dtype=torch.float64)
    return Views(viewmats, K.repeat(count, 1, 1), 10, 9, torch.zeros(3))


def kept(scene, keep, by="paper", **options):
    """Indices of the Gaussians that pruning by a score keeps, found by their centres."""
    pruned = prune(scene, keep, by, **options)
    return (pruned.means[:, None] == scene.means).all(-1).nonzero()[:, 1]


def bits(value):
    return value.contiguous().view(torch.int32)


def test_merging_comes_first_and_coverage_second():
    assert list(METHODS)[:2] == ["merge", "coverage"]


@pytest.mark.parametrize("by", METHODS)
def test_every_method_has_its_own_name_and_a_summary_of_one_clause(by):
    summary = METHODS[by].summary
    assert METHODS[by].name == by
    assert summary and len(summary) < 100 and not summary.endswith(".") and "\n" not in summary


@pytest.mark.parametrize("by", SCORES)
@pytest.mark.parametrize(("keep", "k"), [(0.3, 15), (1, 1), (1.0, 50), (37, 37)])
def test_a_score_keeps_the_k_highest_bit_for_bit_and_in_order(by, keep, k):
    scene = normal_scene(50, 1)
    scene.quats[:, 0] = -0.0
    scene.opacities[::7] = math.inf
    pruned, indices, scores = prune(scene, keep, by), kept(scene, keep, by), score_of(scene, METHODS[by])
    assert len(pruned) == k and len(indices) == k and scores.shape == (50,)
    assert (indices.diff() > 0).all()
    for name, value in pruned.items():
        assert torch.equal(bits(value), bits(getattr(scene, name)[indices])), name
    assert scores[indices].min() >= np.delete(scores.numpy(), indices).max(initial=-math.inf)


@pytest.mark.parametrize("by", WITH_VIEWS)
def test_a_score_from_views_keeps_the_highest_also_of_views_that_are_made_when_due(by):
    scene = normal_scene(60, 1)
    wanted = select(METHODS[by].score(scene, views()), 18)
    assert torch.equal(kept(scene, 0.3, by, views=views()), wanted)
    assert torch.equal(kept(scene, 0.3, by, views=views), wanted)


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
def test_views_are_not_made_for_a_method_that_needs_none(by):
    def never():
        raise AssertionError("views were made")

    assert len(prune(normal_scene(60, 1), 0.3, by, views=never)) == 18


@pytest.mark.parametrize("by", ["merge", *WITH_VIEWS])
def test_progress_rises_to_one(by):
    shares = []
    prune(normal_scene(60, 1), 0.3, by, views=views(), progress=shares.append)
    assert shares and shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
@pytest.mark.parametrize(
    ("keep", "count"),
    [(0.3, 18), (7, 7), (1, 1), (1.0, 60), ("10%", 6), ("0.3", 18), ("7", 7), ("1.0", 60), ("100MB", 60)],
)
def test_a_budget_gives_the_same_count_by_any_method_also_as_text(by, keep, count):
    assert len(prune(normal_scene(60, 1), keep, by)) == count


def test_a_size_keeps_as_many_as_fit_at_the_degree_of_the_scene():
    assert len(prune(normal_scene(50, 1), Megabytes(ply_bytes(20, 1) / 1e6), "paper")) == 20


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
@pytest.mark.parametrize("keep", [0, 0.0, 1.5, math.nan, 61, -1, "0%", "many", "61"])
def test_a_budget_out_of_range_is_refused(by, keep):
    with pytest.raises(BudgetError, match="keep is"):
        prune(normal_scene(60, 1), keep, by)


@pytest.mark.parametrize("keep", ["auto", "auto:35", WithinPsnr(35.0)])
def test_a_budget_that_needs_renders_is_refused(keep):
    with pytest.raises(BudgetError, match="keep is auto, which is found by rendering"):
        prune(normal_scene(60, 1), keep)


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
def test_a_scene_with_no_gaussian_or_none_that_can_be_drawn_is_refused(by):
    with pytest.raises(BudgetError, match="holds no Gaussians"):
        prune(Gaussians.empty(), 0.5, by)
    with pytest.raises(SceneError, match="none of the 60 Gaussians can be drawn"):
        prune(normal_scene(60, 1).map(lambda value: value * math.nan), 5, by)


@pytest.mark.parametrize(
    ("by", "options", "message"),
    [
        ("best", {}, UNKNOWN),
        *((by, {"views": None}, f"{by} looks at the scene from poses; expected views") for by in WITH_VIEWS),
        *(
            (by, {"opacity_weight": 0.5}, f"{by} does not weigh opacity; .* one of paper, authors, log-volume$")
            for by in WITHOUT_OPACITY_WEIGHT
        ),
    ],
)
def test_a_method_that_does_not_exist_or_does_not_take_its_options_is_refused(by, options, message):
    with pytest.raises(PointSplatError, match=message) as caught:
        prune(normal_scene(60, 1), 0.3, by, **{"views": views(), **options})
    assert isinstance(caught.value, DataError) == ("expected views" in message)


def test_the_opacity_weight_reaches_the_score():
    scene = normal_scene(50, 1)
    most_opaque = scene.opacities[:, 0].topk(10).indices.sort().values
    assert torch.equal(kept(scene, 10, opacity_weight=1.0), most_opaque)


def test_a_scene_in_a_graph_stays_in_it():
    scene = normal_scene(60, 1).map(lambda value: value.requires_grad_())
    prune(scene, 5, "paper").means.sum().backward()
    assert scene.means.grad.sum() == 15  # 5 rows of 3 ones


@pytest.mark.parametrize(("keep", "count"), [(0.3, 18), (1.0, 60), (1, 1), (7, 7), (7.0, 7)])
def test_settings_prune_as_prune_does(keep, count):
    scene = normal_scene(60, 1)
    assert len(PruneSettings(keep).prune(scene)) == count
    with_options = PruneSettings(keep, "authors", opacity_weight=0.9).prune(scene)
    assert same(with_options, prune(scene, count, "authors", opacity_weight=0.9))


@pytest.mark.parametrize(("keep", "kind"), [(5000.0, int), (1.0, float)])
def test_settings_hold_a_count_as_an_int_and_one_as_the_ratio_that_it_was_written_as(keep, kind):
    assert type(PruneSettings(keep).keep) is kind


@pytest.mark.parametrize("keep", [0, -1, 0.0, 1.5, 7.25, math.nan, math.inf])
def test_settings_refuse_a_budget_that_is_neither_a_ratio_nor_a_count(keep):
    with pytest.raises(BudgetError, match="expected a ratio above 0 and up to 1 .* or a whole number of Gaussians"):
        PruneSettings(keep)


@pytest.mark.parametrize(
    ("by", "weight", "message"),
    [
        *((by, None, f"{by} looks at a scene from poses; expected a method that needs none") for by in WITH_VIEWS),
        ("best", None, UNKNOWN),
        ("merge", 0.5, "merge does not weigh opacity; .* one of paper, authors, log-volume$"),
    ],
)
def test_settings_refuse_methods_and_options_that_prune_refuses_and_methods_that_need_views(by, weight, message):
    with pytest.raises(PointSplatError, match=message):
        PruneSettings(0.3, by, opacity_weight=weight)
