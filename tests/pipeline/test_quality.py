"""The one judgement of a written scene, and its text."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from making import box_room
from pointsplat_ns.pipeline.quality import (
    Judge,
    PhotoGain,
    Quality,
    judge_of,
    quality_of_file,
    through_file,
)
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.scene.reading import save
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")

SOME = Quality(28.84, 24.2, 0.9132, 12, 1920, 1080, "given views", 33.84, 12.06)


@pytest.fixture(scope="module")
def dense():
    return box_room(0, 400)


def test_the_figures_are_those_of_whole_pictures_over_covered_pixels(dense):
    small = dense[::3]
    views = sample_views(dense, 3, 64, 48)
    found = Judge(dense, ViewProvider(dense, views)).quality(small)
    whole = DenseReference(dense, views)
    assert (found.psnr, found.worst) == whole.psnr(small)
    assert found.ssim == pytest.approx(
        1 - (1 - whole.ssim(small)) / (sum(whole.covered) / 3), abs=1e-6
    )
    assert (found.fill_before, found.fill) == (fill(dense, views), fill(small, views))


def test_few_pixels_of_large_pictures_stand_for_all(dense):
    small = dense[::3]
    views = sample_views(dense, 4, 960, 720)
    found = Judge(dense, ViewProvider(dense, views)).quality(small)
    whole = DenseReference(dense, views)
    assert found.psnr == pytest.approx(whole.psnr(small)[0], abs=0.1)
    assert found.ssim == pytest.approx(
        1 - (1 - whole.ssim(small)) / (sum(whole.covered) / 4), abs=0.05
    )
    assert (found.views, found.width, found.height) == (4, 960, 720)


def test_a_file_that_loses_is_judged_as_it_is_read(dense, tmp_path):
    source = ViewProvider(dense, sample_views(dense, 2, 64, 48))
    save(dense, tmp_path / "same.splat")
    read = through_file(dense, ".splat")[1]
    wanted = Judge(dense, source).quality(read)
    assert 10 < wanted.psnr < 60 and "looks the same" not in str(wanted)
    assert quality_of_file(Judge(dense, source), dense, tmp_path / "same.splat") == wanted
    exact = quality_of_file(Judge(dense, source), dense, tmp_path / "same.ply")
    assert str(exact) == "more than 60 dB, SSIM 1.00: looks the same" and "inf" not in exact.details


@pytest.mark.parametrize(
    "psnr, line",
    [
        (math.inf, "more than 60 dB, SSIM 0.91: looks the same"),
        (40.0, "40.0 dB, SSIM 0.91: looks the same"),
        (28.84, "28.8 dB, SSIM 0.91: edges of small things blur"),
        (-3.0, "-3.0 dB, SSIM 0.91: only large shapes are left"),
    ],
)
def test_one_line_says_how_good_a_scene_is(psnr, line):
    assert str(replace(SOME, psnr=psnr)) == line == replace(SOME, psnr=psnr).as_dict()["quality"]


def test_photos_lead_where_they_were_trained_on():
    trained = replace(SOME, photos=PhotoGain(19.24, 26.1, 12, kept=True))
    assert str(trained) == (
        "19.2 -> 26.1 dB in 12 training photos; 28.8 dB, SSIM 0.91 against the dense scene"
    )
    left_out = replace(SOME, photos=PhotoGain(19.24, 19.1, 12, kept=False))
    assert str(left_out) == (
        "19.2 dB in 12 photos, which training on them does not raise; 28.8 dB, SSIM 0.91: edges "
        "of small things blur"
    )


def test_where_nothing_is_visible_nothing_is_judged(dense):
    unseen = dense.replace(opacities=dense.opacities - 100)
    assert (
        quality_of_file(judge_of(unseen, ViewProvider(unseen)), unseen, Path("unseen.ply")) is None
    )
