"""Feedback, and training with it."""

import math

import pytest
import torch

from making import assert_same_on_any_threads
from pointsplat_ns.pipeline.feedback_features import REPAIR, Feedback
from pointsplat_ns.pipeline.optimiser import Adam, AdamSettings, nonzero_rms
from pointsplat_ns.pruning import prune
from pointsplat_ns.refinement.feedback import FeedbackRefiner, shipped_feedback_refiner
from pointsplat_ns.scene.gaussians import PARAMETERS, Gaussians


@pytest.fixture(scope="module")
def scene(hollow_ball) -> Gaussians:
    return prune(hollow_ball, 60, "merge")


def gradients(scene: Gaussians, seed: int, size: float = 1.0) -> dict[str, torch.Tensor]:
    """Random ones; a third of the Gaussians is not seen."""
    generator = torch.Generator().manual_seed(seed)
    values = {
        name: size * torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value)
        for name, value in scene.items()
    }
    for value in values.values():
        value[::3] = 0
    return values


@pytest.mark.parametrize("settings", [REPAIR.adam, AdamSettings()], ids=["repairs", "fine-tuning"])
def test_steps_that_are_not_learned_are_those_of_adam(scene, settings):
    feedback = Adam(scene, settings)
    values = {name: value.clone() for name, value in scene.items()}
    first = gradients(scene, 0)
    groups = [
        {
            "params": [values[name]],
            "lr": feedback.rates[name],
            "eps": max(settings.damping * nonzero_rms(first[name]), 1e-15),
        }
        for name in PARAMETERS
        if values[name].numel()
    ]
    adam = torch.optim.Adam(groups, betas=settings.betas)
    moved = {name: value.clone() for name, value in scene.items()}
    for seed in range(4):
        given = gradients(scene, seed)
        for name, value in values.items():
            value.grad = given[name]
        adam.step()
        feedback.observe(given)
        steps = feedback.moves(1.0)
        moved = {name: value + steps[name] for name, value in moved.items()}
    for name in PARAMETERS:
        torch.testing.assert_close(moved[name], values[name], rtol=1e-5, atol=1e-7)


def test_factors_reach_their_parameters_and_what_no_view_shows_stays(scene):
    feedback = Feedback(scene, 1000)
    given = gradients(scene, 0)
    for value in given.values():
        value[3] = 0.0
    feedback.observe(given)
    plain = feedback.moves(0.5)
    untrained = FeedbackRefiner()(feedback.features(scene, 0.0, 8))
    for name, moved in feedback.moves(0.5, untrained).items():
        torch.testing.assert_close(moved, plain[name])
    factors = torch.arange(1.0, 7.0).expand(len(scene), 6)
    learned = feedback.moves(0.5, factors)
    for kind, name in enumerate(PARAMETERS):
        torch.testing.assert_close(learned[name], (kind + 1) * plain[name])
        assert not learned[name][3].any()


def test_factors_in_pieces_are_those_of_the_whole(scene):
    many = scene[torch.arange(5000) % len(scene)]
    feedback = Feedback(many, 9000)
    network = shipped_feedback_refiner(torch.device("cpu"))
    feedback.observe(gradients(many, 0))
    expected = network(feedback.features(many, 0.5, 8))
    torch.testing.assert_close(feedback.factors(network, many, 0.5, 8), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-12, 1.0, 1e18])
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("weighed", [False, True])
def test_a_step_in_one_pass_is_one_after_the_other(scene, size, degree, weighed):
    rest = torch.zeros(len(scene), (degree + 1) ** 2 - 1, 3)
    many = scene.replace(features_rest=rest)[torch.arange(2500) % len(scene)]
    many.opacities[0] = math.inf
    many.opacities[1] = -math.inf
    many.scales[2, 0] = -math.inf
    many = many.replace(features_rest=many.features_rest.mT.contiguous().mT)  # other strides
    factors = (
        torch.rand(len(many), 6, generator=torch.Generator().manual_seed(2)) if weighed else None
    )

    def after(dtype, at_once):
        now = many.to(dtype)
        adam = Adam(many.to(dtype), AdamSettings(faster=4.0, damping=0.01))
        for seed in range(3):
            if at_once:
                now = adam.stepped(now, gradients(now, seed, size), lambda _: (0.5, factors))
            else:
                adam.observe(gradients(now, seed, size))
                now = adam.moved(now, 0.5, factors)
        return [*now.tensors(), *adam.state().values()]

    ours = after(torch.float32, True)
    torchs = after(torch.float32, False)
    exact = after(torch.float64, True)
    for mine, theirs, right in zip(ours, torchs, exact, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-7)
        if size != 1e-30:  # its square is 0 in float32
            torch.testing.assert_close(mine.double(), right, rtol=1e-4, atol=1e-6 * max(1.0, size))


def test_a_step_is_the_same_on_any_threads(scene):
    many = scene[torch.arange(9000) % len(scene)]

    def step():
        return (
            Adam(many, AdamSettings())
            .stepped(many, gradients(many, 1), lambda _: (1.0, None))
            .tensors()
        )

    assert_same_on_any_threads(step)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1.0, 1e18])
@pytest.mark.parametrize("degree", [0, 3])
def test_features_and_steps_are_right_at_the_extremes(scene, size, degree):
    rest = torch.zeros(len(scene), (degree + 1) ** 2 - 1, 3)
    wild = scene.replace(
        features_rest=rest, opacities=scene.opacities.clone(), scales=scene.scales.clone()
    )
    wild.opacities[0] = math.inf
    wild.opacities[1] = -math.inf
    wild.scales[2, 0] = -math.inf
    wild.scales[3] = 80.0
    found = []
    for dtype in (torch.float32, torch.float64):
        feedback = Feedback(wild.to(dtype), 1000)
        for seed in (0, 1):
            feedback.observe(gradients(wild.to(dtype), seed, size))
        features = feedback.features(wild.to(dtype), 1.0, 10**6)
        moves = feedback.moves(1.0)
        assert (
            features.shape == (len(scene), FeedbackRefiner.FEATURES)
            and features.dtype == torch.float32
        )
        assert bool(features.isfinite().all()) and float(features.abs().max()) <= 8
        assert all(bool(value.isfinite().all()) for value in moves.values())
        found.append((features, moves))
    if 1e-18 < size or size == 0:  # squares of smaller gradients are 0 in float32
        torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-3, atol=1e-3)
        for name in PARAMETERS:
            torch.testing.assert_close(
                found[0][1][name].double(), found[1][1][name], rtol=1e-4, atol=1e-6
            )
