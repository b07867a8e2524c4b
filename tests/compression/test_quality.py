"""The figure of quality that commands print."""

import pytest
import torch

from making import box_room
from pointsplat_ns.compression.quality import FullSizeQuality, quality_of
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.fill import fill
from pointsplat_ns.looking.sampling import sample_views


@pytest.fixture(scope="module")
def dense():
    return box_room(0, 400)


def test_the_figure_is_that_of_whole_pictures_over_covered_pixels(dense):
    small = dense[::3]
    views = sample_views(dense, 3, 64, 48)
    assert quality_of(dense, small, views).psnr == DenseReference(dense, views).psnr(small)[0]
    large = sample_views(dense, 3, 1280, 960)
    subsampled = quality_of(dense, small, large)
    assert subsampled.psnr == pytest.approx(DenseReference(dense, large).psnr(small)[0], abs=0.1)
    assert (subsampled.views, subsampled.width, subsampled.height) == (3, 1280, 960)


def test_the_quality_is_said_with_the_views_and_their_size(dense):
    close, drawn = str(FullSizeQuality(31.249, 8, 1920, 1080, 33.84, 12.06)).splitlines()
    assert close == "31.2 dB PSNR against the dense scene (8 views, 1920 x 1080)"
    assert drawn == "fill: 33.8 -> 12.1 Gaussians drawn per pixel"
    same = quality_of(dense, dense, sample_views(dense, 1, 64, 48))
    assert str(same).startswith("no difference from the dense scene (1 view, 64 x 48)\n")


def test_fill_is_that_of_both_scenes_in_the_compared_views(dense):
    views = sample_views(dense, 2, 64, 48)
    found = quality_of(dense, dense[::3], views[1:])
    assert (found.fill_before, found.fill) == (fill(dense, views[1:]), fill(dense[::3], views[1:]))
    assert 0 < found.fill < found.fill_before


def test_views_that_the_finish_of_merging_compared_are_left_out(dense):
    views, small = sample_views(dense, 6, 64, 48), dense[::3]
    assert len(views) == 6
    assert quality_of(dense, small, views).psnr == quality_of(dense, small, views[torch.tensor([1, 4])]).psnr
