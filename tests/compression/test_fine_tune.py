"""Optimising what was kept against the dense scene's renders."""

import math

import pytest
import torch

from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.errors import DataError
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.pruning import METHODS, score_of, select


def test_fine_tuning_comes_closer_to_the_dense_scene_and_leaves_its_input_alone(hollow_ball, ball_views):
    kept = hollow_ball[select(score_of(hollow_ball, METHODS["coverage"]), 500)]
    before = [value.clone() for value in kept.tensors()]
    shares = []
    tuned = fine_tune(kept, ball_views, hollow_ball, 20, progress=shares.append)
    reference = DenseReference(hollow_ball, ball_views)
    assert reference.psnr(tuned)[0] > reference.psnr(kept)[0] + 1
    assert len(tuned) == 500 and not any(value.requires_grad for value in tuned.tensors())
    assert all(torch.equal(a, b) for a, b in zip(before, kept.tensors(), strict=True))
    assert shares == pytest.approx([(i + 1) / 20 for i in range(20)])


def test_fine_tuning_takes_pictures_too_and_no_steps_change_nothing(hollow_ball, ball_views):
    pictures = DenseReference(hollow_ball, ball_views).renders
    a, b = (
        fine_tune(hollow_ball[:300], ball_views, pictures, 3),
        fine_tune(hollow_ball[:300], ball_views, hollow_ball, 3),
    )
    assert all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))
    same = fine_tune(hollow_ball[:300], ball_views, hollow_ball, 0)
    assert all(torch.equal(x, y) for x, y in zip(same.tensors(), hollow_ball[:300].tensors(), strict=True))


def test_fine_tuning_leaves_infinite_parameters_where_they_are(hollow_ball, ball_views):
    spoiled = hollow_ball[:300].map(torch.clone)
    spoiled.opacities[3], spoiled.opacities[4], spoiled.scales[5, 1] = math.inf, -math.inf, -math.inf
    tuned = fine_tune(spoiled, ball_views, hollow_ball, 4)
    assert tuned.opacities[3] == math.inf and tuned.opacities[4] == -math.inf and tuned.scales[5, 1] == -math.inf
    assert bool(tuned.usable().all()) and not torch.equal(tuned.features_dc, spoiled.features_dc)


def test_fine_tuning_says_what_does_not_fit(hollow_ball, ball_views):
    with pytest.raises(DataError, match="no view"):
        fine_tune(hollow_ball, ball_views[:0], hollow_ball, 1)
    with pytest.raises(DataError, match="1 pictures for 4 views"):
        fine_tune(hollow_ball, ball_views, [torch.zeros(48, 64, 3)], 1)
    with pytest.raises(DataError, match="picture . has shape"):
        fine_tune(hollow_ball, ball_views, [torch.zeros(8, 8, 3)] * 4, 1)
