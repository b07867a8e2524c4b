"""Equation 3 to the letter, at ordinary values and where exponentials overflow."""

import math

import numpy as np
import pytest
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import SCORES, paper_score


def make(n=50, degree=1, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    shapes = [(n, 3), (n, 3), (n, 4), (n, 1), (n, 3), (n, (degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator, dtype=dtype) for shape in shapes))


def equation_3(scene, weight):
    """The formula as printed, in numpy's extended precision."""
    scales, logits = (x.double().numpy().astype(np.longdouble) for x in (scene.scales, scene.opacities[:, 0]))
    alpha = 1 / (1 + np.exp(-logits))
    volume = (
        np.longdouble(4 / 3) * np.longdouble(np.pi) * np.exp(scales[:, 0]) * np.exp(scales[:, 1]) * np.exp(scales[:, 2])
    )
    z = [(x - x.mean()) / x.std() for x in (alpha, volume)]
    return torch.from_numpy((weight * z[0] + (1 - weight) * z[1]).astype(np.float64))


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_paper_score_is_equation_3(weight, dtype):
    scene = make(dtype=dtype)
    scene = scene.replace(scales=3 * scene.scales - 4)
    # 1e-12: both are computed in at least float64, over 50 terms
    assert torch.allclose(paper_score(scene, weight), equation_3(scene, weight), rtol=1e-12, atol=1e-12)


def test_the_papers_weight_is_the_default():
    assert torch.equal(paper_score(make()), paper_score(make(), 0.3))


def test_a_ball_outranks_a_pancake_of_smaller_volume():
    # The product of the logarithms, which is no volume, would rank them the other way around.
    scales = torch.log(torch.tensor([[0.1, 0.1, 1e-5], [0.01, 0.01, 0.01], [0.02, 0.02, 0.02]]))
    scene = make(3).replace(scales=scales, opacities=torch.zeros(3, 1))
    score = paper_score(scene)
    assert score[2] > score[1] > score[0]


@pytest.mark.parametrize("shift", [-80.0, 80.0, -1e4, 1e4])
def test_log_scales_far_out_neither_overflow_nor_change_the_score(shift):
    scene = make(dtype=torch.float64)
    # Powers of two keep the shifted log-scales exact enough: 1e4 leaves 12 digits of each, hence 1e-8.
    moved = paper_score(scene.replace(scales=scene.scales + shift))
    assert moved.isfinite().all() and torch.allclose(moved, paper_score(scene), atol=1e-8)


def test_a_spread_beyond_any_exponent_is_finite_and_finds_the_giant():
    scales = torch.full((4, 3), -80.0)
    scales[2] = 80.0
    score = paper_score(make(4).replace(scales=scales, opacities=torch.zeros(4, 1)))
    assert score.isfinite().all() and int(score.argmax()) == 2


@pytest.mark.parametrize("case", ["one", "same", "flat"])
def test_without_variance_every_score_is_zero(case):
    n = 1 if case == "one" else 6
    scene = make(1)[[0] * n]
    if case == "flat":
        scene = scene.replace(scales=torch.full((n, 3), -math.inf))
    assert paper_score(scene).tolist() == [0.0] * n


def test_infinite_logits_are_opacity_1_and_0():
    logits = torch.tensor([[math.inf], [-math.inf], [0.0], [40.0]])
    score = paper_score(make(4).replace(opacities=logits, scales=torch.zeros(4, 3)), 1.0)
    assert score.isfinite().all()
    assert score[0] >= score[3] > score[2] > score[1] and score[2] == pytest.approx(
        float((score[0] + score[1]) / 2), abs=0.5
    )


def test_flat_gaussians_have_no_volume():
    scales = torch.zeros(3, 3)
    scales[1, 2] = -math.inf
    score = paper_score(make(3).replace(scales=scales, opacities=torch.zeros(3, 1)))
    assert score.isfinite().all() and int(score.argmin()) == 1


@pytest.mark.parametrize("name", sorted(SCORES))
def test_unusable_gaussians_score_nan_and_leave_the_others_alone(name):
    scene = make(6)
    spoiled = scene.replace(means=scene.means.clone(), scales=scene.scales.clone())
    spoiled.means[1, 0], spoiled.scales[4, 2] = math.nan, math.inf
    score = SCORES[name](spoiled)
    assert score.isnan().tolist() == [False, True, False, False, True, False]
    if name != "random":
        assert torch.equal(score[[0, 2, 3, 5]], SCORES[name](scene[[0, 2, 3, 5]]))


@pytest.mark.parametrize("name", sorted(SCORES))
def test_every_score_is_float64_and_takes_an_empty_scene(name):
    assert SCORES[name](make(5)).dtype == torch.float64 and SCORES[name](make(5)).shape == (5,)
    assert SCORES[name](Gaussians.empty()).shape == (0,)
    only_bad = make(2).map(lambda value: value * math.nan)
    assert SCORES[name](only_bad).isnan().all()


def test_opacity_and_volume_rank_as_alpha_and_the_volume_do():
    scene = make(dtype=torch.float64)
    assert torch.equal(SCORES["opacity"](scene).argsort(), scene.alphas.argsort())
    assert torch.equal(SCORES["volume"](scene).argsort(), scene.stds.prod(dim=1).argsort())
    volume = 4 / 3 * math.pi * scene.stds.prod(dim=1)
    assert torch.allclose(SCORES["volume"](scene).exp(), volume, rtol=1e-12)


def test_random_is_the_same_for_one_seed_and_another_for_the_next():
    scene = make()
    assert torch.equal(SCORES["random"](scene, seed=3), SCORES["random"](scene, seed=3))
    assert not torch.equal(SCORES["random"](scene, seed=3), SCORES["random"](scene, seed=4))


@pytest.mark.parametrize("weight", [-0.1, 1.1, math.nan])
def test_a_weight_outside_its_range_is_said(weight):
    with pytest.raises(ValueError, match="expected 0 to 1"):
        paper_score(make(), weight)
