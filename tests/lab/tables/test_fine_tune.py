"""Fine-tuning of the baselines."""

import pytest
import torch

from lab.tables.fine_tune import fine_tune
from pointsplat_ns.errors import DataError
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.pruning import METHODS, score_of, select


def tuned(scene, views, targets, steps, progress=lambda share: None):
    return fine_tune(scene, views, targets, steps, 0, progress)


def test_fine_tuning_comes_closer_to_the_dense_scene_and_leaves_its_input_alone(hollow_ball, ball_views):
    kept = hollow_ball[select(score_of(hollow_ball, METHODS["coverage"]), 500)]
    before = [value.clone() for value in kept.tensors()]
    shares = []
    scene = tuned(kept, ball_views, hollow_ball, 20, shares.append)
    reference = DenseReference(hollow_ball, ball_views)
    assert reference.psnr(scene)[0] > reference.psnr(kept)[0] + 1
    assert len(scene) == 500 and not any(value.requires_grad for value in scene.tensors())
    assert all(torch.equal(a, b) for a, b in zip(before, kept.tensors(), strict=True))
    assert shares == pytest.approx([(i + 1) / 20 for i in range(20)])


def test_fine_tuning_takes_pictures_too_and_no_steps_change_nothing(hollow_ball, ball_views):
    pictures = DenseReference(hollow_ball, ball_views).renders
    by_pictures, by_renders = (tuned(hollow_ball[:300], ball_views, targets, 3) for targets in (pictures, hollow_ball))
    assert all(torch.equal(x, y) for x, y in zip(by_pictures.tensors(), by_renders.tensors(), strict=True))
    same = tuned(hollow_ball[:300], ball_views, hollow_ball, 0)
    assert all(torch.equal(x, y) for x, y in zip(same.tensors(), hollow_ball[:300].tensors(), strict=True))


def test_fine_tuning_says_what_does_not_fit(hollow_ball, ball_views):
    with pytest.raises(DataError, match="no view"):
        tuned(hollow_ball, ball_views[:0], hollow_ball, 1)
    with pytest.raises(DataError, match="1 pictures for 4 views"):
        tuned(hollow_ball, ball_views, [torch.zeros(48, 64, 3)], 1)
    with pytest.raises(DataError, match="picture . has shape"):
        tuned(hollow_ball, ball_views, [torch.zeros(8, 8, 3)] * 4, 1)
