"""Exactly K, always the same K, and those kept are untouched."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import SCORES, Megabytes, ply_bytes, prune, select


def make(n=50, degree=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = [(n, 3), (n, 3), (n, 4), (n, 1), (n, 3), (n, (degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def by_sorting(scores, k):
    """The definition: sort by (NaN last, score descending, index), take k, order by index."""
    order = sorted(
        range(len(scores)), key=lambda i: (math.isnan(scores[i]), -scores[i] if scores[i] == scores[i] else 0, i)
    )
    return sorted(order[:k])


values = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, 1.0, 2.0, math.nan, math.inf, -math.inf])
)  # few values, so that ties are common


@settings(max_examples=200)
@given(st.lists(values, max_size=30).flatmap(lambda x: st.tuples(st.just(x), st.integers(0, len(x)))))
def test_select_is_its_definition(case):
    scores, k = case
    found = select(torch.tensor(scores, dtype=torch.float64), k)
    assert found.tolist() == by_sorting(scores, k) and found.dtype == torch.int64


def test_ties_go_to_the_lower_index():
    assert select(torch.tensor([1.0, 2.0, 1.0, 2.0, 1.0]), 3).tolist() == [0, 1, 3]
    assert select(torch.zeros(10_000), 17).tolist() == list(range(17))


def test_nan_comes_after_minus_infinity():
    assert select(torch.tensor([math.nan, -math.inf, math.nan, 0.0]), 3).tolist() == [0, 1, 3]


@pytest.mark.parametrize("k", [-1, 6])
def test_more_or_fewer_than_there_are_is_said(k):
    with pytest.raises(BudgetError, match=f"cannot select {k} of 5 Gaussians; expected 0 to 5"):
        select(torch.zeros(5), k)


def bits(value):
    return value.contiguous().view(torch.int32)


@pytest.mark.parametrize("by", sorted(SCORES))
@pytest.mark.parametrize(("keep", "k"), [(0.3, 15), (1, 1), (1.0, 50), (37, 37)])
def test_prune_keeps_exactly_k_bit_for_bit_and_in_order(by, keep, k):
    scene = make()
    scene.quats[:, 0] = -0.0
    scene.opacities[::7] = math.inf
    pruned = prune(scene, keep, by)
    assert len(pruned.scene) == k and len(pruned.indices) == k and pruned.scores.shape == (50,)
    assert (pruned.indices.diff() > 0).all()
    for name, value in pruned.scene.items():
        assert torch.equal(bits(value), bits(getattr(scene, name)[pruned.indices])), name
    assert pruned.scores[pruned.indices].min() >= np.delete(pruned.scores.numpy(), pruned.indices).max(
        initial=-math.inf
    )


def test_a_smaller_budget_keeps_a_subset_of_a_larger_one():
    scene = make(200)
    kept = [set(prune(scene, keep).indices.tolist()) for keep in (0.1, 0.3, 0.5)]
    assert kept[0] < kept[1] < kept[2]


def test_pruning_does_not_depend_on_scale_or_units():
    scene = make(200)
    metres = scene.replace(means=scene.means * 1000, scales=scene.scales.double().add(math.log(1000)).float())
    assert prune(scene, 0.3).indices.tolist() == prune(metres, 0.3).indices.tolist()


def test_options_reach_the_score():
    scene = make()
    most_opaque = scene.opacities[:, 0].topk(10).indices.sort().values
    assert torch.equal(prune(scene, 10, opacity_weight=1.0).indices, most_opaque)


def test_a_scene_in_a_graph_stays_in_it():
    scene = make().map(lambda value: value.requires_grad_())
    prune(scene, 5).scene.means.sum().backward()
    assert scene.means.grad.sum() == 15  # 5 rows of 3 ones


def test_an_unknown_score_is_said_with_those_there_are():
    with pytest.raises(PointSplatError, match="no score is called 'best'; expected one of coverage, paper, authors"):
        prune(make(), 0.5, by="best")


@pytest.mark.parametrize("by", sorted(SCORES))
def test_a_scene_with_nothing_to_draw_is_refused(by):
    with pytest.raises(SceneError, match="none of the 4 Gaussians can be drawn"):
        prune(make(4).map(lambda value: value * math.nan), 0.5, by)
    with pytest.raises(BudgetError, match="holds no Gaussians"):
        prune(Gaussians.empty(), 0.5, by)


def test_a_size_keeps_what_fits_at_the_degree_of_the_scene():
    scene = make(50, degree=1)
    kept = prune(scene, Megabytes(ply_bytes(20, 1) / 1e6)).scene
    assert len(kept) == 20
