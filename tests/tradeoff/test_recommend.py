"""Losses and recommendations."""

import math
from dataclasses import replace

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.tradeoff import measuring
from pointsplat_ns.tradeoff.recommend import PHOTO_PSNR, expected_loss, fastest_within, recommend
from trades import POINTS, point


@pytest.mark.parametrize(("loss", "key"), [(0, "dense"), (0.1, "half"), (0.49, "half"), (0.5, "third"), (3, "tenth")])
def test_the_fastest_that_is_good_enough(loss, key):
    assert fastest_within(POINTS, loss).key == key  # 30.1 - 29.6 is a little more than 0.5


@pytest.mark.parametrize("db, key", [(43, "dense"), (42, "half"), (35, "third"), (30, "tenth")])
def test_without_photos_the_loss_is_that_expected_of_renders(db, key):
    without = [replace(point, against_photos=None) for point in POINTS]
    assert fastest_within(without, expected_loss(db)).key == key


def test_of_two_as_fast_the_smaller_is_recommended_and_where_times_mean_nothing_the_fewest_gaussians():
    twin = replace(POINTS[3], key="twin", bytes=20)
    assert fastest_within([*POINTS, twin], 0.5).key == "twin"
    slow = replace(POINTS[1], key="few", frame_ms=1e6, gaussians=1)
    assert fastest_within([*POINTS, slow], 100, trusted=False).key == "few"
    assert fastest_within([*POINTS, slow], 100).key != "few"


def test_the_expected_loss_is_that_of_independent_errors():
    """Seed 0. The errors of 300,000 values are independent to a thousandth or so."""
    generator = torch.Generator().manual_seed(0)
    photo, of_training, of_merging = (torch.randn(1, 100, 1000, 3, generator=generator).double() for _ in range(3))
    dense = photo + 10 ** (-PHOTO_PSNR / 20) * of_training
    small = dense + 10 ** (-33.0 / 20) * of_merging
    lost = float(ps.psnr(dense, photo) - ps.psnr(small, photo))
    assert lost == pytest.approx(expected_loss(float(ps.psnr(small, dense))), abs=0.02)


@pytest.mark.parametrize("photos, loss", [((30.0, 25.0, 27.75), "loses 2.25 dB:"), ((None,) * 3, "has 30.0 dB:")])
def test_the_dense_scene_comes_with_the_next_best_and_its_cost(photos, loss):
    settings = ("dense", 100, math.inf, photos[0], 500), ("poor", 5, 20.0, photos[1], 1), ("b", 50, 30.0, photos[2], 90)
    dense, poor, other = (point(*some) for some in settings)
    best, why = recommend([dense, poor, other], 0.5)
    limit = "loses at most 0.5 dB against held-out photos" if photos[0] else "has 36.1 dB against the dense scene, as"
    assert best is dense and why.startswith(f"no faster point {limit}")
    assert f"; the best, the b, {loss} 90 Gaussians, 0.900 kB in place of 5.00 kB, " in why
    assert "50 ms a frame in place of 100, made in 3 s" in why
    assert "the best" not in recommend([dense], 0.5)[1]
    for trusted, what in ((True, "the fastest point that"), (False, "the point with the fewest Gaussians that")):
        best, why = recommend([dense, poor, other], 2.5, trusted)
        assert best is other and why.startswith(f"{what} ") and (" ms" in why) == trusted


def test_a_machine_is_busy_when_too_few_cores_are_left(monkeypatch):
    monkeypatch.setattr(measuring, "cores", lambda: 4)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert [bool(measuring.busy_note([others])) for others in (0.0, 2.0, 2.3, 4.0)] == [False, False, True, True]
    assert measuring.busy_note([None, 2.0]) == ""
    assert "while 1 of 2 points were timed, other programs took up to 3.0 of 4" in measuring.busy_note([None, 2.0, 3.0])
