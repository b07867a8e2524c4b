"""Sentences on results."""

import math
from dataclasses import replace

import pytest

from pointsplat_ns.pipeline.quality import PhotoGain, Quality
from pointsplat_ns.pipeline.reasons import Cause, Reason
from pointsplat_ns.pipeline.report import PsnrSearch, ShCut, SizeSearch, TargetSearch
from pointsplat_ns.pipeline.view_provider import Origin, ViewOrigin
from pointsplat_ns.tools.wording import (
    origin_text,
    quality_json,
    quality_text,
    reason_text,
    search_text,
    sh_text,
    target_text,
    tradeoff_estimate,
)

SOME = Quality(28.84, 24.2, 0.9132, 12, 1920, 1080, ViewOrigin(Origin.GIVEN), 33.84, 12.06)


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
    found = replace(SOME, psnr=psnr)
    assert quality_text(found) == line == quality_json(found)["quality"]


def test_photos_lead_where_they_were_trained_on():
    trained = replace(SOME, photos=PhotoGain(19.24, 26.1, 12, accepted=True))
    assert quality_text(trained) == (
        "19.2 -> 26.1 dB in 12 training photos; 28.8 dB, SSIM 0.91 against the dense scene"
    )
    left_out = replace(SOME, photos=PhotoGain(19.24, 19.1, 12, accepted=False))
    assert quality_text(left_out) == (
        "19.2 dB in 12 photos, not improved by training on them; 28.8 dB, SSIM 0.91: edges "
        "of small things blur"
    )


@pytest.mark.parametrize("cause", Cause)
def test_every_reason_has_words_and_its_numbers(cause):
    reason = Reason(cause, count=7, total=1200, decibels=0.25, error="nothing is visible")
    text = reason_text(reason)
    first = text.split()[0]
    assert first in (first.lower(), "PSNR")
    numbers = {
        Cause.NOT_FINITE: "7 of 1,200",
        Cause.SMALL_GAIN: "0.25 dB",
        Cause.WORSE_IN_OTHER_PHOTOS: "0.2 dB",
        Cause.NOT_COMPARED: "(nothing is visible)",
    }
    assert numbers.get(cause, "") in text


@pytest.mark.parametrize("kind", [Origin.GIVEN, Origin.DATASET])
def test_known_views_are_named_by_their_origin(kind):
    assert origin_text(ViewOrigin(kind)) in ("given views", "poses of the dataset")


def test_a_missing_dataset_is_said_in_brackets():
    assert origin_text(ViewOrigin(Origin.SAMPLED, None, "x: moved")).endswith(
        " (no dataset: x: moved)"
    )


def test_searches_say_what_they_reached_and_what_it_cost():
    assert search_text(SizeSearch(3, 1e6, "SPZ")) == "3 sizes tried for 1.00 MB as SPZ"
    assert search_text(PsnrSearch(1, 30.04, 61.0, 2)) == (
        "1 size tried: 30.0 dB against the dense scene, more than 60 dB in the worst of 2 views"
    )
    found = TargetSearch(psnr=30.0, bytes=2000, gaussians=1500, tried=4, interrupted=True)
    assert target_text(found) == (
        "30.0 dB against the dense scene, 2.00 kB, 1,500 Gaussians; 4 sizes tried, interrupted"
    )
    assert target_text(replace(found, photos=3, dense_psnr=31.0)).startswith(
        "30.0 dB in 3 held-out photos, the dense scene 31.0 dB, "
    )


def test_sh_that_stays_and_that_goes():
    assert sh_text(ShCut(1, 1)) == "SH degree 1 kept"
    assert sh_text(ShCut(3, 1, lost=0.25, psnr=41.0)) == (
        "SH degree 3 cut to 1: colours change 25% less with the view, 41.0 dB PSNR against all "
        "bands"
    )


@pytest.mark.parametrize(
    ("seconds", "quick", "rough"),
    [
        (0.2, False, "10 s on this machine"),
        (44.0, False, "40 s on this machine"),
        (226.0, True, "4 min on this machine"),
        (226.0, False, "4 min on this machine; --quick gives a first look"),
        (9000.0, True, "2.5 h on this machine"),
    ],
)
def test_a_duration_in_advance_has_few_digits(seconds, quick, rough):
    said = tradeoff_estimate(13, 57_574, seconds, quick)
    assert said == f"measuring 13 points of 57,574 Gaussians takes about {rough}"
