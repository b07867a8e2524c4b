"""One way in for every method."""

import math

import pytest
import torch

from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import MERGE, METHODS, SCORES, compact, prune


def make(n=60, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = [(n, 3), (n, 3), (n, 4), (n, 1), (n, 3), (n, 3, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def test_the_methods_are_merging_and_the_scores():
    assert METHODS == (MERGE, *SCORES)


@pytest.mark.parametrize("by", sorted(SCORES))
def test_a_score_chooses_as_prune_does(by):
    scene = make()
    for a, b in zip(compact(scene, 0.3, by).tensors(), prune(scene, 0.3, by).scene.tensors(), strict=True):
        assert torch.equal(a, b)


def test_merging_makes_exactly_as_many_as_asked():
    for keep, count in ((0.3, 18), (7, 7), (1, 1), (1.0, 60)):
        assert len(compact(make(), keep)) == count


@pytest.mark.parametrize("by", METHODS)
def test_what_cannot_be_made_is_refused(by):
    for keep in (0, 0.0, 1.5, math.nan, 61, -1):
        with pytest.raises(BudgetError, match="keep is"):
            compact(make(), keep, by)
    with pytest.raises(SceneError, match="can be drawn"):
        compact(make().map(lambda value: value * math.nan), 5, by)
    with pytest.raises(BudgetError, match="holds no Gaussians"):
        compact(Gaussians.empty(), 5, by)


def test_an_unknown_method_is_said():
    with pytest.raises(PointSplatError, match="no method is called 'best'; expected one of merge, coverage, paper"):
        compact(make(), 0.5, "best")
