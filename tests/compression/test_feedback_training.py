"""Training the network that sets the steps of a repair."""

import random
from dataclasses import replace

import pytest
import torch

from pointsplat_ns.compression import feedback_training
from pointsplat_ns.compression.feedback_training import (
    FeedbackTrainingSettings,
    TrainingScene,
    roll_out,
    train_feedback,
)
from pointsplat_ns.errors import DataError
from pointsplat_ns.refiner.feedback import FeedbackRefiner, read_feedback_refiner


@pytest.fixture
def small(hollow_ball, monkeypatch) -> TrainingScene:
    monkeypatch.setattr(feedback_training, "TRAINING", FeedbackTrainingSettings(steps=(6,)))
    monkeypatch.setattr(feedback_training, "RESOLUTION", (48, 27))
    return TrainingScene.of("ball", hollow_ball, ["10%", "20%"], view_batches=1)


def test_a_scene_is_merged_to_each_budget_and_has_views(small, hollow_ball):
    assert {budget: len(scene) for budget, scene in small.pruned.items()} == {"10%": 150, "20%": 300}
    assert all((len(views), views.width, views.height) == (32, 48, 27) for views in small.views)
    assert small.dense is hollow_ball
    assert 5 < small.psnr["10%"] < small.psnr["20%"] < 50


def test_training_brings_repairs_closer(small, tmp_path):
    """The same repairs before and after."""

    def reached(network: FeedbackRefiner) -> float:
        with torch.no_grad():
            repairs = [roll_out(network, small, "20%", 6, random.Random(seed)) for seed in range(4)]
        return float(torch.stack(repairs).mean())

    shares: list[float] = []
    network = train_feedback([small], 25, at_once=1, output=tmp_path / "a.safetensors", progress=shares.append)
    assert shares[-1] == 1 and len(shares) == 25
    assert reached(network) > reached(FeedbackRefiner()) + 0.05
    saved = read_feedback_refiner(tmp_path / "a.safetensors")
    assert reached(saved) == pytest.approx(reached(network), abs=1e-4)


def test_a_seed_gives_the_same_network(small):
    first, second = (train_feedback([small], 2, at_once=1, seed=3) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


def test_scenes_that_cannot_be_trained_on_are_refused(small):
    with pytest.raises(DataError, match="no scene"):
        train_feedback([], 1)
    with pytest.raises(DataError, match="ball: 8 views; expected at least 9"):
        train_feedback([replace(small, views=(small.views[0][:8], small.views[1][:8]))], 1)


def test_views_are_by_default_as_large_as_those_of_repairs(hollow_ball, monkeypatch):
    monkeypatch.setattr(feedback_training, "TRAINING", FeedbackTrainingSettings(batch_views=2))
    views = TrainingScene.of("ball", hollow_ball, ["20%"], view_batches=1).views
    assert all((len(size), size.width, size.height) == (2, 784, 441) for size in views)
    assert views[0].eps2d > 5 * views[1].eps2d
