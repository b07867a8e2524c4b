"""Scores, and exactly the K highest."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from making import normal_scene, splats
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pruning import METHODS, prune, score_of, select
from pointsplat_ns.pruning.baselines import mass_shares
from pointsplat_ns.scene.gaussians import Gaussians

SCORES = {
    name: method.score
    for name, method in METHODS.items()
    if method.score and not method.needs_views
}


def z(x):
    return (x - x.mean()) / x.std()


def exactly(scene):
    """Opacities (N,), standard deviations (N, 3), logits and log-scales in numpy's extended
    precision."""
    logits, scales = (
        x.double().numpy().astype(np.longdouble) for x in (scene.opacities[:, 0], scene.scales)
    )
    return 1 / (1 + np.exp(-logits)), np.exp(scales), logits, scales


FORMULAS = {
    "paper": lambda w, alpha, s, *_: (
        w * z(alpha) + (1 - w) * z(np.longdouble(4 / 3 * math.pi) * s.prod(1))
    ),
    "authors": lambda w, alpha, s, logit, log_s: (
        w * z(logit) + (1 - w) * z((log_s + np.longdouble(1e-6)).prod(1))
    ),
    "opacity": lambda w, alpha, s, logit, *_: logit,
}
"""Scores as printed, from a weight of opacity and what :func:`exactly` gives."""


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("weight", [None, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_score_is_its_formula_with_the_papers_weight_by_default(name, weight, dtype):
    scene = normal_scene(50, 1, dtype=dtype)
    scene = scene.replace(scales=3 * scene.scales - 4)
    options = (
        {} if weight is None or not METHODS[name].weighs_opacity else {"opacity_weight": weight}
    )
    wanted = FORMULAS[name](0.3 if weight is None else weight, *exactly(scene))
    # 1e-12: both are computed in at least float64, over 50 terms
    assert torch.allclose(
        SCORES[name](scene, **options),
        torch.from_numpy(wanted.astype(np.float64)),
        rtol=1e-12,
        atol=1e-12,
    )


@pytest.mark.parametrize("name", sorted(SCORES))
def test_unusable_gaussians_score_nan_and_leave_the_others_alone(name):
    scene = normal_scene(6, 1)
    spoiled = scene.replace(means=scene.means.clone(), scales=scene.scales.clone())
    spoiled.means[1, 0] = math.nan
    spoiled.scales[4, 2] = math.inf
    score = SCORES[name](spoiled)
    assert (
        score.isnan().tolist() == [False, True, False, False, True, False]
        and score.dtype == torch.float64
    )
    assert SCORES[name](spoiled[[1, 4]]).isnan().all() and SCORES[name](
        Gaussians.empty()
    ).shape == (0,)
    if name not in (
        "random",
        "coverage",
    ):  # their values depend on how many there are; test_coverage has the other's
        assert torch.equal(score[[0, 2, 3, 5]], SCORES[name](scene[[0, 2, 3, 5]]))


@pytest.mark.parametrize("name", sorted(SCORES))
@pytest.mark.parametrize(
    "case", ["huge", "tiny", "mixed", "infinite logits", "flat", "flat and clear", "far", "equal"]
)
def test_no_score_of_what_can_be_drawn_is_nan(name, case):
    scene = normal_scene(40, 1)
    infinite = torch.tensor([math.inf, -math.inf]).repeat(20)[:, None]
    flat = scene.scales.clone()
    flat[::3, 1] = -math.inf
    scene = {
        "huge": lambda: scene.replace(scales=torch.full((40, 3), 80.0)),
        "tiny": lambda: scene.replace(scales=torch.full((40, 3), -80.0)),
        "mixed": lambda: scene.replace(
            scales=80 * scene.scales.sign(), opacities=80 * scene.opacities.sign()
        ),
        "infinite logits": lambda: scene.replace(opacities=infinite),
        "flat": lambda: scene.replace(scales=flat),
        "flat and clear": lambda: scene.replace(
            scales=torch.full((40, 3), -math.inf), opacities=infinite
        ),
        "far": lambda: scene.replace(means=scene.means * 1e37),
        "equal": lambda: scene[[0] * 40],
    }[case]()
    score = SCORES[name](scene)
    assert not score.isnan().any()
    assert (score < math.inf).all() or name == "opacity"  # whose score is the logit
    assert len(prune(scene, 7, name)) == 7


@pytest.mark.parametrize("name", ["paper", "authors", "opacity"])
def test_infinite_logits_keep_their_rank(name):
    scene = normal_scene(9, 1)
    logits = torch.linspace(-3, 3, 9)[:, None]
    logits[0] = -math.inf
    logits[-1] = math.inf
    score = SCORES[name](scene.replace(opacities=logits, scales=torch.zeros(9, 3)))
    assert (score.diff() >= 0).all() and score[-1] > score[4] > score[0]


@pytest.mark.parametrize("weight", [-0.1, 1.1, math.nan])
@pytest.mark.parametrize(
    "name", [name for name, method in METHODS.items() if method.weighs_opacity]
)
def test_an_opacity_weight_outside_its_range_is_refused(name, weight):
    with pytest.raises(ValueError, match="expected 0 to 1"):
        SCORES[name](normal_scene(50, 1), opacity_weight=weight)


def by_sorting(scores, k):
    """The definition: sort by (NaN last, score descending, index), take k, order by index."""
    order = sorted(
        range(len(scores)),
        key=lambda i: (math.isnan(scores[i]), -scores[i] if scores[i] == scores[i] else 0, i),
    )
    return sorted(order[:k])


values = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, 1.0, 2.0, math.nan, math.inf, -math.inf])
)  # few values, so that ties are common


@settings(max_examples=80)
@given(
    st.lists(values, max_size=30).flatmap(lambda x: st.tuples(st.just(x), st.integers(0, len(x))))
)
def test_select_is_its_definition(case):
    scores, k = case
    found = select(torch.tensor(scores, dtype=torch.float64), k)
    assert found.tolist() == by_sorting(scores, k) and found.dtype == torch.int64


@pytest.mark.parametrize("k", [-1, 6])
def test_more_or_fewer_than_there_are_is_said(k):
    with pytest.raises(BudgetError, match=f"cannot select {k} of 5 Gaussians; expected 0 to 5"):
        select(torch.zeros(5), k)


def shares_by_definition(masses, run, first):
    result = [0.0] * len(masses)
    edges = sorted({0, *range(first, len(masses), run), len(masses)})
    for begin, end in zip(edges, edges[1:], strict=False):
        part = list(range(begin, end))
        ranked = sorted(part, key=lambda i: (-masses[i], i))
        total = sum(masses[i] for i in part)
        for place, i in enumerate(ranked):
            if total == 0:
                result[i] = (len(part) - place) / len(part)
            else:
                result[i] = sum(masses[j] for j in ranked[place:]) / total
    return result


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0, 3.0, 700.0]), max_size=40),
    st.integers(1, 7),
    st.data(),
)
def test_mass_shares_are_their_definition(masses, run, data):
    first = data.draw(st.integers(0, run - 1))
    found = mass_shares(torch.tensor(masses, dtype=torch.float64).log(), run, first)
    # 1e-12: sums of at most 7 numbers in float64, their logarithms included
    wanted = torch.tensor(shares_by_definition(masses, run, first), dtype=torch.float64)
    assert torch.allclose(found, wanted, rtol=0, atol=1e-12)


def test_no_region_is_emptied_at_ten_percent_where_other_scores_empty_one():
    # A wall of large opaque Gaussians, and a far larger number of faint and small ones that make up
    # another.
    generator = torch.Generator().manual_seed(3)
    big = torch.rand(400, 3, generator=generator) * torch.tensor([0.0, 1.0, 1.0])
    small = torch.rand(1600, 3, generator=generator) * torch.tensor([0.0, 1.0, 1.0]) + torch.tensor(
        [1.0, 0.0, 0.0]
    )
    scales = torch.cat([torch.full((400,), -2.0), torch.full((1600,), -5.0)])
    logits = torch.cat([torch.full((400,), 2.0), torch.full((1600,), -1.0)]) + torch.randn(
        2000, generator=generator
    )
    scene = splats(torch.cat([big, small]), scales[:, None], logits[:, None])
    cell = (scene.means[:, 0] > 0.5) * 16 + (scene.means[:, 1] * 4).long().clamp_max(3) * 4
    cell = cell + (scene.means[:, 2] * 4).long().clamp_max(3)
    kept = {by: select(score_of(scene, METHODS[by]), 200) for by in ("coverage", "paper")}
    regions = {by: len(cell[indices].unique()) for by, indices in kept.items()}
    assert regions["coverage"] == 32 and regions["paper"] < 20
