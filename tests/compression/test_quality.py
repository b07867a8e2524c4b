"""How good a smaller scene is at full size, measured in bands of pictures."""

from __future__ import annotations

import pytest
import torch

from making import box_room
from pointsplat_ns.compression import quality
from pointsplat_ns.compression.quality import Quality, QualitySettings, quality_of
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.sampling import sample_views


@pytest.fixture(scope="module")
def dense():
    return box_room(0, 400)


def test_bands_of_all_rows_have_the_psnr_of_whole_pictures_over_covered_pixels(dense, monkeypatch):
    views, small = sample_views(dense, 3, 64, 48), dense[::3]
    wanted, _ = DenseReference(dense, views).psnr(small)
    assert quality_of(dense, small, views).psnr == wanted
    monkeypatch.setattr(quality, "QUALITY", QualitySettings(bands=1, rows=47))  # all rows but one
    banded = quality_of(dense, small, views)
    assert banded.psnr == pytest.approx(wanted, abs=0.2) and banded.psnr != wanted
    assert (banded.views, banded.width, banded.height) == (3, 64, 48)


def test_the_quality_is_said_with_the_views_and_their_size(dense):
    assert str(Quality(31.249, 8, 1920, 1080)) == "31.2 dB PSNR against the dense scene (8 views, 1920 x 1080)"
    same = quality_of(dense, dense, sample_views(dense, 1, 64, 48))
    assert str(same) == "no difference from the dense scene (1 view, 64 x 48)"


def test_views_that_the_finish_of_merging_compared_are_left_out(dense):
    views, small = sample_views(dense, 6, 64, 48), dense[::3]
    assert len(views) == 6
    assert quality_of(dense, small, views).psnr == quality_of(dense, small, views[torch.tensor([1, 4])]).psnr
