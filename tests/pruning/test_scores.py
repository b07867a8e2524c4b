"""Equation 3 to the letter, at ordinary values and where exponentials overflow."""

import math

import numpy as np
import pytest
import torch

from making import normal_scene
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import METHODS, prune
from pointsplat_ns.pruning.scores import paper_score

SCORES = {name: method.score for name, method in METHODS.items() if method.score and not method.needs_views}


def equation_3(scene, weight):
    """The formula as printed, in numpy's extended precision."""
    scales, logits = (x.double().numpy().astype(np.longdouble) for x in (scene.scales, scene.opacities[:, 0]))
    alpha = 1 / (1 + np.exp(-logits))
    volume = (
        np.longdouble(4 / 3) * np.longdouble(np.pi) * np.exp(scales[:, 0]) * np.exp(scales[:, 1]) * np.exp(scales[:, 2])
    )
    z = [(x - x.mean()) / x.std() for x in (alpha, volume)]
    return torch.from_numpy((weight * z[0] + (1 - weight) * z[1]).astype(np.float64))


@pytest.mark.parametrize("weight", [None, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_paper_score_is_equation_3_with_the_papers_weight_by_default(weight, dtype):
    scene = normal_scene(50, 1, dtype=dtype)
    scene = scene.replace(scales=3 * scene.scales - 4)
    found = paper_score(scene) if weight is None else paper_score(scene, weight)
    # 1e-12: both are computed in at least float64, over 50 terms
    assert torch.allclose(found, equation_3(scene, 0.3 if weight is None else weight), rtol=1e-12, atol=1e-12)


def test_a_ball_outranks_a_pancake_of_smaller_volume_and_the_authors_score_ranks_them_the_other_way_around():
    scales = torch.log(torch.tensor([[0.1, 0.1, 1e-5], [0.01, 0.01, 0.01], [0.02, 0.02, 0.02]]))
    scene = normal_scene(3, 1).replace(scales=scales, opacities=torch.zeros(3, 1))
    volume, product = SCORES["paper"](scene), SCORES["authors"](scene)
    assert volume[2] > volume[1] > volume[0] and product[0] > product[1]


@pytest.mark.parametrize("shift", [-80.0, 80.0, -1e4, 1e4])
def test_log_scales_far_out_neither_overflow_nor_change_the_score(shift):
    scene = normal_scene(50, 1, dtype=torch.float64)
    # Powers of two keep the shifted log-scales exact enough: 1e4 leaves 12 digits of each, hence 1e-8.
    moved = paper_score(scene.replace(scales=scene.scales + shift))
    assert moved.isfinite().all() and torch.allclose(moved, paper_score(scene), atol=1e-8)


@pytest.mark.parametrize("case", ["one", "same", "flat"])
def test_without_variance_every_score_is_zero(case):
    n = 1 if case == "one" else 6
    scene = normal_scene(1, 1)[[0] * n]
    if case == "flat":
        scene = scene.replace(scales=torch.full((n, 3), -math.inf))
    assert paper_score(scene).tolist() == [0.0] * n


def test_flat_gaussians_have_no_volume():
    scales = torch.zeros(3, 3)
    scales[1, 2] = -math.inf
    score = paper_score(normal_scene(3, 1).replace(scales=scales, opacities=torch.zeros(3, 1)))
    assert score.isfinite().all() and int(score.argmin()) == 1


@pytest.mark.parametrize("name", sorted(SCORES))
def test_unusable_gaussians_score_nan_and_leave_the_others_alone(name):
    scene = normal_scene(6, 1)
    spoiled = scene.replace(means=scene.means.clone(), scales=scene.scales.clone())
    spoiled.means[1, 0], spoiled.scales[4, 2] = math.nan, math.inf
    score = SCORES[name](spoiled)
    assert score.isnan().tolist() == [False, True, False, False, True, False]
    if name not in ("random", "coverage"):  # their values depend on how many there are; test_coverage has the other's
        assert torch.equal(score[[0, 2, 3, 5]], SCORES[name](scene[[0, 2, 3, 5]]))


@pytest.mark.parametrize("name", sorted(SCORES))
def test_every_score_is_float64_and_takes_an_empty_scene(name):
    assert SCORES[name](normal_scene(5, 1)).dtype == torch.float64 and SCORES[name](normal_scene(5, 1)).shape == (5,)
    assert SCORES[name](Gaussians.empty()).shape == (0,)
    only_bad = normal_scene(2, 1).map(lambda value: value * math.nan)
    assert SCORES[name](only_bad).isnan().all()


def test_opacity_and_volume_rank_as_alpha_and_the_volume_do():
    scene = normal_scene(50, 1, dtype=torch.float64)
    assert torch.equal(SCORES["opacity"](scene).argsort(), scene.alphas.argsort())
    assert torch.equal(SCORES["volume"](scene).argsort(), scene.stds.prod(dim=1).argsort())
    volume = 4 / 3 * math.pi * scene.stds.prod(dim=1)
    assert torch.allclose(SCORES["volume"](scene).exp(), volume, rtol=1e-12)


def test_random_is_the_same_for_one_seed_and_another_for_the_next():
    scene = normal_scene(50, 1)
    assert torch.equal(SCORES["random"](scene, seed=3), SCORES["random"](scene, seed=3))
    assert not torch.equal(SCORES["random"](scene, seed=3), SCORES["random"](scene, seed=4))


def z(x):
    return (x - x.mean()) / x.std()


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_authors_is_the_formula_of_the_released_code(weight):
    scene = normal_scene(50, 1)
    logits, scales = (x.double().numpy().astype(np.longdouble) for x in (scene.opacities[:, 0], scene.scales))
    product = np.longdouble(4 / 3 * math.pi) * np.prod(scales + np.longdouble(1e-6), axis=1)
    wanted = torch.from_numpy((weight * z(logits) + (1 - weight) * z(product)).astype(np.float64))
    # 1e-12: float64 over 50 terms
    assert torch.allclose(SCORES["authors"](scene, opacity_weight=weight), wanted, rtol=1e-12, atol=1e-12)


def test_log_volume_is_eq_3_with_the_logarithm():
    scene = normal_scene(50, 1)
    alphas = 1 / (1 + np.exp(-scene.opacities[:, 0].double().numpy()))
    wanted = 0.3 * z(alphas) + 0.7 * z(scene.scales.double().sum(1).numpy())
    assert np.allclose(SCORES["log-volume"](scene), wanted, rtol=1e-12, atol=1e-12)


def test_area_is_alpha_times_the_two_largest_axes():
    scene = normal_scene(50, 1, dtype=torch.float64)
    largest = scene.stds.sort(dim=1, descending=True).values
    # 1e-12: a handful of roundings in float64
    assert torch.allclose(SCORES["area"](scene).exp(), scene.alphas * largest[:, 0] * largest[:, 1], rtol=1e-12)


@pytest.mark.parametrize("name", sorted(SCORES))
@pytest.mark.parametrize("case", ["huge", "tiny", "mixed", "infinite logits", "flat", "flat and clear", "far", "equal"])
def test_no_score_of_what_can_be_drawn_is_nan(name, case):
    scene = normal_scene(40, 1)
    infinite = torch.tensor([math.inf, -math.inf]).repeat(20)[:, None]
    flat = scene.scales.clone()
    flat[::3, 1] = -math.inf
    scene = {
        "huge": lambda: scene.replace(scales=torch.full((40, 3), 80.0)),
        "tiny": lambda: scene.replace(scales=torch.full((40, 3), -80.0)),
        "mixed": lambda: scene.replace(scales=80 * scene.scales.sign(), opacities=80 * scene.opacities.sign()),
        "infinite logits": lambda: scene.replace(opacities=infinite),
        "flat": lambda: scene.replace(scales=flat),
        "flat and clear": lambda: scene.replace(scales=torch.full((40, 3), -math.inf), opacities=infinite),
        "far": lambda: scene.replace(means=scene.means * 1e37),
        "equal": lambda: scene[[0] * 40],
    }[case]()
    score = SCORES[name](scene)
    assert not score.isnan().any()
    assert (score < math.inf).all() or name == "opacity"  # whose score is the logit
    assert len(prune(scene, 7, name)) == 7


@pytest.mark.parametrize("name", sorted(set(SCORES) - {"random"}))
def test_float32_and_float64_rank_alike(name):
    scene = normal_scene(300, 1)
    single, double = SCORES[name](scene), SCORES[name](scene.to(torch.float64))
    # Both are computed in float64 from the same values, positions in a grid of 2^20 cells included.
    assert torch.allclose(single, double, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["paper", "authors", "opacity", "area", "log-volume"])
def test_infinite_logits_keep_their_rank(name):
    scene = normal_scene(9, 1)
    logits = torch.linspace(-3, 3, 9)[:, None]
    logits[0], logits[-1] = -math.inf, math.inf
    score = SCORES[name](scene.replace(opacities=logits, scales=torch.zeros(9, 3)))
    assert (score.diff() >= 0).all() and score[-1] > score[4] > score[0]


@pytest.mark.parametrize("name", sorted(set(SCORES) - {"opacity", "random"}))
def test_a_single_giant_is_found_and_leaves_the_others_apart(name):
    scene = normal_scene(60, 1)
    scene = scene.replace(scales=scene.scales.clone(), opacities=torch.zeros(60, 1))
    scene.scales[17] = 80.0
    score = SCORES[name](scene)
    assert score.isfinite().all() and score[17] == score.max()
    if name not in ("paper", "authors"):  # whose z-scores the giant does flatten: that is their formula
        assert len(score.unique()) > 30


@pytest.mark.parametrize("weight", [-0.1, 1.1, math.nan])
@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.weighs_opacity])
def test_an_opacity_weight_outside_its_range_is_refused(name, weight):
    with pytest.raises(ValueError, match="expected 0 to 1"):
        SCORES[name](normal_scene(50, 1), opacity_weight=weight)
