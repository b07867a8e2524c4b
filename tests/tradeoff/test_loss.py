"""What a scene loses: as photos say, or as they would."""

import math

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.tradeoff.front import PHOTO_PSNR, expected_loss, loss_of, psnr_within, recommend
from pointsplat_ns.tradeoff.settings import DENSE, Setting
from trades import point

ALL = Setting(100_000, 3, by=DENSE)


@pytest.mark.parametrize("loss", [0.05, 0.5, 3.0, 10.0])
def test_the_loss_at_the_psnr_for_a_loss_is_that_loss(loss):
    assert expected_loss(psnr_within(loss)) == pytest.approx(loss)


def test_the_expected_loss_is_that_of_independent_errors():
    """Seed 0. The errors of 300,000 values are independent to a thousandth or so."""
    generator = torch.Generator().manual_seed(0)
    photo, of_training, of_merging = (torch.randn(1, 100, 1000, 3, generator=generator).double() for _ in range(3))
    dense = photo + 10 ** (-PHOTO_PSNR / 20) * of_training
    small = dense + 10 ** (-33.0 / 20) * of_merging
    lost = float(ps.psnr(dense, photo) - ps.psnr(small, photo))
    assert lost == pytest.approx(expected_loss(float(ps.psnr(small, dense))), abs=0.02)


def test_photos_are_believed_where_they_are():
    dense, small = point(ALL, math.inf, photos=30.0), point(Setting(1000, 3), 50.0, photos=28.5)
    assert loss_of(small, dense) == 1.5
    assert loss_of(point(Setting(1000, 3), 50.0), point(ALL, math.inf)) == expected_loss(50.0)


def test_the_fastest_within_the_loss_is_recommended_not_the_smallest():
    dense = point(ALL, math.inf, 100.0)
    slow, fast, poor = (point(Setting(n, 3), db, ms) for n, db, ms in ((500, 40, 30), (900, 37, 20), (100, 20, 5)))
    best, why = recommend([dense, slow, fast, poor], 0.5)
    assert best is fast
    assert f"at least {psnr_within(0.5):.1f} dB" in why and "20 ms a frame in place of 100" in why


def test_where_times_mean_nothing_counts_decide():
    dense = point(ALL, math.inf, 1.0)
    few, many = point(Setting(500, 3), 40, 30.0), point(Setting(900, 3), 45, 2.0)
    best, why = recommend([dense, many, few], 0.5, trusted=False)
    assert best is few and "fewest Gaussians" in why and "ms" not in why


def test_where_nothing_is_good_enough_the_dense_scene_is_what_remains():
    dense, poor = point(ALL, math.inf, 100.0, photos=30.0), point(Setting(100, 3), 20, 5, photos=25.0)
    best, why = recommend([dense, poor], 0.5)
    assert best is dense
    assert "is the dense scene itself" in why and "30.0 dB against held-out photos" in why
