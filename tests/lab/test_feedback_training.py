"""Training of the feedback network."""

import random
from collections.abc import Iterator

import pytest
import torch

from lab import feedback_training
from lab.feedback_training import FeedbackTrainingSettings, TrainingScene, roll_out, train_feedback
from pointsplat_ns.refinement.feedback import FeedbackRefiner, read_feedback_refiner

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def small(hollow_ball) -> Iterator[TrainingScene]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feedback_training, "TRAINING", FeedbackTrainingSettings(steps=(6,)))
        patch.setattr(feedback_training, "RESOLUTION", (48, 27))
        yield TrainingScene.of("ball", hollow_ball, ["10%", "20%"], view_batches=1)


def test_training_brings_repairs_closer(small, tmp_path):

    def reached(network: FeedbackRefiner) -> float:
        with torch.no_grad():
            repairs = [roll_out(network, small, "20%", 6, random.Random(seed)) for seed in range(4)]
        return float(torch.stack(repairs).mean())

    shares: list[float] = []
    network = train_feedback(
        [small], 25, at_once=1, output=tmp_path / "a.safetensors", progress=shares.append
    )
    assert shares[-1] == 1 and len(shares) == 25
    assert reached(network) > reached(FeedbackRefiner()) + 0.05
    saved = read_feedback_refiner(tmp_path / "a.safetensors")
    assert reached(saved) == pytest.approx(reached(network), abs=1e-4)
