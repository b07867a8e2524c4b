"""The registry of methods, and the one way through it: exact counts, what is kept, what is refused."""

import math

import numpy as np
import pytest
import torch

from making import normal_scene
from pointsplat_ns.errors import BudgetError, DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import METHODS, Megabytes, PruneSettings, WithinPsnr, ply_bytes, prune, score_of, select
from pointsplat_ns.views import Views

SCORES = [name for name, method in METHODS.items() if method.score and not method.needs_views]
WITHOUT_VIEWS = [name for name, method in METHODS.items() if not method.needs_views]
WITH_VIEWS = [name for name, method in METHODS.items() if method.needs_views]
WITHOUT_OPACITY_WEIGHT = [name for name, method in METHODS.items() if not method.weighs_opacity]


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
def test_every_method_is_registered_under_its_own_name(by):
    assert METHODS[by].name == by


@pytest.mark.parametrize("by", METHODS)
def test_every_method_says_in_one_clause_what_it_is(by):
    summary = METHODS[by].summary
    assert summary and len(summary) < 100 and not summary.endswith(".") and "\n" not in summary


@pytest.mark.parametrize("by", SCORES)
def test_a_score_keeps_the_gaussians_it_ranks_highest(by):
    scene = normal_scene(60, 1)
    chosen = scene[select(score_of(scene, METHODS[by]), 18)]
    for a, b in zip(prune(scene, 0.3, by).tensors(), chosen.tensors(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("by", WITH_VIEWS)
def test_a_score_that_looks_from_views_keeps_the_gaussians_it_ranks_highest(by):
    scene = normal_scene(60, 1)
    wanted = select(METHODS[by].score(scene, views()), 18)
    assert torch.equal(kept(scene, 0.3, by, views=views()), wanted)


@pytest.mark.parametrize("by", WITH_VIEWS)
def test_views_may_be_made_when_they_are_due(by):
    scene = normal_scene(60, 1)
    assert torch.equal(kept(scene, 0.3, by, views=views), kept(scene, 0.3, by, views=views()))


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
def test_views_are_not_made_for_a_method_that_needs_none(by):
    def never():
        raise AssertionError("views were made")

    assert len(prune(normal_scene(60, 1), 0.3, by, views=never)) == 18


@pytest.mark.parametrize("by", WITH_VIEWS)
def test_a_method_that_needs_views_says_that_there_are_none(by):
    with pytest.raises(DataError, match=f"{by} looks at the scene from poses; expected views"):
        prune(normal_scene(60, 1), 0.3, by)


@pytest.mark.parametrize("by", ["merge", *WITH_VIEWS])
def test_progress_rises_to_one(by):
    shares = []
    prune(normal_scene(60, 1), 0.3, by, views=views(), progress=shares.append)
    assert shares and shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize(("keep", "count"), [(0.3, 18), (7, 7), (1, 1), (1.0, 60)])
def test_merging_makes_exactly_as_many_as_asked(keep, count):
    assert len(prune(normal_scene(60, 1), keep)) == count


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
@pytest.mark.parametrize(("keep", "count"), [("10%", 6), ("0.3", 18), ("7", 7), ("1.0", 60), ("100MB", 60)])
def test_a_budget_may_be_written_as_on_the_command_line(by, keep, count):
    assert len(prune(normal_scene(60, 1), keep, by)) == count


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
def test_a_scene_with_nothing_to_draw_is_refused(by):
    with pytest.raises(SceneError, match="none of the 60 Gaussians can be drawn"):
        prune(normal_scene(60, 1).map(lambda value: value * math.nan), 5, by)


@pytest.mark.parametrize("by", WITHOUT_VIEWS)
def test_a_scene_without_gaussians_is_refused(by):
    with pytest.raises(BudgetError, match="holds no Gaussians"):
        prune(Gaussians.empty(), 0.5, by)


def test_an_unknown_method_is_said_with_those_there_are():
    with pytest.raises(
        PointSplatError, match="no method is called 'best'; expected one of merge, coverage, paper, auth"
    ):
        prune(normal_scene(60, 1), 0.5, "best")


@pytest.mark.parametrize("by", SCORES)
@pytest.mark.parametrize(("keep", "k"), [(0.3, 15), (1, 1), (1.0, 50), (37, 37)])
def test_a_score_keeps_exactly_k_bit_for_bit_and_in_order(by, keep, k):
    scene = normal_scene(50, 1)
    scene.quats[:, 0] = -0.0
    scene.opacities[::7] = math.inf
    pruned, indices, scores = prune(scene, keep, by), kept(scene, keep, by), score_of(scene, METHODS[by])
    assert len(pruned) == k and len(indices) == k and scores.shape == (50,)
    assert (indices.diff() > 0).all()
    for name, value in pruned.items():
        assert torch.equal(bits(value), bits(getattr(scene, name)[indices])), name
    assert scores[indices].min() >= np.delete(scores.numpy(), indices).max(initial=-math.inf)


def test_a_smaller_budget_keeps_a_subset_of_a_larger_one():
    scene = normal_scene(200, 1)
    sets = [set(kept(scene, keep).tolist()) for keep in (0.1, 0.3, 0.5)]
    assert sets[0] < sets[1] < sets[2]


def test_pruning_does_not_depend_on_scale_or_units():
    scene = normal_scene(200, 1)
    metres = scene.replace(means=scene.means * 1000, scales=scene.scales.double().add(math.log(1000)).float())
    assert kept(scene, 0.3).tolist() == kept(metres, 0.3).tolist()


def test_the_opacity_weight_reaches_the_score():
    scene = normal_scene(50, 1)
    most_opaque = scene.opacities[:, 0].topk(10).indices.sort().values
    assert torch.equal(kept(scene, 10, opacity_weight=1.0), most_opaque)


@pytest.mark.parametrize("by", WITHOUT_OPACITY_WEIGHT)
def test_an_opacity_weight_is_refused_by_methods_that_do_not_weigh_it(by):
    with pytest.raises(PointSplatError, match=f"{by} does not weigh opacity; .* one of paper, authors, log-volume$"):
        prune(normal_scene(60, 1), 0.3, by, views=views(), opacity_weight=0.5)


def test_a_scene_in_a_graph_stays_in_it():
    scene = normal_scene(60, 1).map(lambda value: value.requires_grad_())
    prune(scene, 5, "paper").means.sum().backward()
    assert scene.means.grad.sum() == 15  # 5 rows of 3 ones


def test_a_size_keeps_what_fits_at_the_degree_of_the_scene():
    assert len(prune(normal_scene(50, 1), Megabytes(ply_bytes(20, 1) / 1e6), "paper")) == 20


@pytest.mark.parametrize(("keep", "count"), [(0.3, 18), (1.0, 60), (1, 1), (7, 7), (7.0, 7)])
def test_settings_prune_to_a_ratio_or_a_count(keep, count):
    assert len(PruneSettings(keep).prune(normal_scene(60, 1))) == count


def test_settings_prune_as_prune_does():
    scene = normal_scene(60, 1)
    settings = PruneSettings(0.3, "authors", opacity_weight=0.9)
    for a, b in zip(
        settings.prune(scene).tensors(), prune(scene, 0.3, "authors", opacity_weight=0.9).tensors(), strict=True
    ):
        assert torch.equal(a, b)


def test_settings_hold_a_count_as_an_int_however_it_was_written():
    assert type(PruneSettings(5000.0).keep) is int


def test_settings_hold_one_as_a_ratio_if_it_was_written_as_one():
    assert type(PruneSettings(1.0).keep) is float


@pytest.mark.parametrize("keep", [0, -1, 0.0, 1.5, 7.25, math.nan, math.inf])
def test_settings_refuse_what_is_neither_a_ratio_nor_a_count(keep):
    with pytest.raises(BudgetError, match="expected a ratio above 0 and up to 1 .* or a whole number of Gaussians"):
        PruneSettings(keep)


@pytest.mark.parametrize("by", WITH_VIEWS)
def test_settings_refuse_methods_that_need_views(by):
    with pytest.raises(PointSplatError, match=f"{by} looks at a scene from poses; expected a method that needs none"):
        PruneSettings(0.3, by)


def test_settings_refuse_a_method_that_there_is_not():
    with pytest.raises(PointSplatError, match="no method is called 'best'; expected one of merge, coverage"):
        PruneSettings(0.3, "best")


def test_settings_refuse_an_opacity_weight_that_would_have_no_effect():
    with pytest.raises(PointSplatError, match="merge does not weigh opacity; .* one of paper, authors, log-volume$"):
        PruneSettings(0.3, opacity_weight=0.5)
