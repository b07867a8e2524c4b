"""Searches for a count and for a size."""

import functools
import math

import pytest

from making import cloud, same
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pipeline.budget_search import (
    SLOPE,
    FileLimit,
    find_count,
    largest_within,
    psnr_for_rounding,
    smallest_within,
)
from pointsplat_ns.pipeline.options import PruneOptions
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.report import PsnrSearch
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import METHODS, WithinPsnr, score_of, select
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.formats import Format, format_to_write
from pointsplat_ns.scene.formats.rounding import rounding_for
from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.gaussians import Gaussians

pytestmark = pytest.mark.usefixtures("quick")

MOST = 100_000

MEASURES = {
    "straight over the logarithm": lambda count: 40 + 6 * math.log(count / MOST),
    "bent": lambda count: 40 * (count / MOST) ** 0.2,
    "proportional": lambda count: math.log(16 * count + 500),
    "a time with a share that is always there": lambda count: math.log(5.0 + count / 1000),
    "in one step": lambda count: 20.0 if count < 12_345 else 40.0,
    "endless for the whole": lambda count: (
        math.inf if count == MOST else 30 + math.log(count / MOST)
    ),
}


def searched(measure, target, at_least, first=30_000, slope=6.0, tolerance=1e-6, **options):
    tried = {}

    def measured(count):
        assert 1 <= count <= MOST and count not in tried, "measured twice, or out of bounds"
        tried[count] = measure(count)
        return tried[count], count

    found = find_count(measured, target, at_least, first, MOST, slope, tolerance, **options)
    assert found.tried == tried
    return found.best, tried


@pytest.mark.parametrize("at_least", [True, False])
@pytest.mark.parametrize("share", [0.001, 0.07, 0.3, 0.5, 0.99])
@pytest.mark.parametrize("name", MEASURES)
def test_the_count_meets_the_target_and_its_tried_neighbour_does_not(name, share, at_least):
    measure = MEASURES[name]
    target = measure(round(share * MOST))
    found, tried = searched(measure, target, at_least)
    meets = (lambda value: value >= target) if at_least else (lambda value: value <= target)
    assert meets(tried[found])
    missed = [count for count, value in tried.items() if not meets(value)]
    low, high = (
        (max(missed, default=0), found) if at_least else (found, min(missed, default=MOST + 1))
    )
    assert high <= max(low, 1) * 1.05 or high - low == 1 or abs(tried[found] - target) <= 1e-6
    assert len(tried) <= 20


def test_a_count_near_enough_to_the_target_ends_the_search():
    found, tried = searched(MEASURES["straight over the logarithm"], 28.0, True, tolerance=0.1)
    assert 28.0 <= tried[found] <= 28.1 and len(tried) <= 3


def test_tries_are_limited_once_one_meets_the_target():
    assert len(searched(MEASURES["bent"], 20.0, True, tries=2)[1]) == 2
    found, tried = searched(MEASURES["bent"], 39.9, True, first=10, tries=2)
    assert found is not None and len(tried) > 2


def test_ctrl_c_gives_the_best_so_far_only_where_that_is_wanted():
    def measure(count):
        if count < MOST:
            raise KeyboardInterrupt
        return 1.0, count

    with pytest.raises(KeyboardInterrupt):
        find_count(measure, 0.5, True, MOST, MOST, 1.0, 0.1)
    found = find_count(measure, 0.5, True, MOST, MOST, 1.0, 0.1, stoppable=True)
    assert found.best == MOST and found.interrupted


def test_bounds_are_tried_before_it_gives_up():
    found, tried = searched(MEASURES["bent"], 41.0, True)
    assert found is None and MOST in tried
    found, tried = searched(MEASURES["bent"], 0.1, False)
    assert found is None and min(tried) == 1


@pytest.mark.parametrize("wanted", [22.0, 30.0])
def test_the_scene_found_is_good_enough_and_a_little_smaller_one_is_not(
    hollow_ball, ball_views, wanted
):
    scores = score_of(hollow_ball, METHODS["coverage"])
    reference = DenseReference(hollow_ball, ball_views)

    def measure(count):
        scene = hollow_ball[select(scores, count)]
        return reference.psnr(scene)[0], scene

    scene, found = smallest_within(len(hollow_ball), measure, wanted)
    count = len(scene)
    psnr = reference.psnr(scene)[0]
    below = [k for k in found.tried if k < count]
    assert psnr >= wanted and (
        psnr <= wanted + 0.1 or count <= max(max(below) * 1.05, max(below) + 1)
    )
    assert all(found.tried[k] < wanted for k in below) and len(found.tried) <= 8
    shares = []
    request = PruneOptions(WithinPsnr(wanted), "coverage")
    source = ViewProvider(hollow_ball, given=ball_views)
    pruned = prune_scene(
        hollow_ball,
        request,
        source,
        lambda what, share: shares.append(share) if what == "trying counts" else None,
    )
    assert same(pruned.scene, scene)
    assert isinstance(pruned.search, PsnrSearch) and pruned.search.psnr == pytest.approx(psnr)
    steps = [after - before for before, after in zip([0.0, *shares], shares, strict=False)]
    assert 0 < min(steps) and max(steps) <= 0.25 / len(ball_views) + 0.02 and shares[-1] < 1, (
        "the bar never jumps"
    )


def search(full, limit, encode=encode_spz):
    limit = FileLimit(Format("SPZ", ".spz", encode=encode), limit)
    return largest_within(full, lambda count: full[:count], limit, lambda share: None)


def test_a_budget_for_less_than_one_gaussian_is_refused():
    with pytest.raises(BudgetError, match="too small for one Gaussian; expected at least"):
        search(cloud(100), 10)


def test_a_size_that_jumps_ends_the_search_with_what_fits():
    # Beyond 50 Gaussians the file is ten times as large.
    scene, _, _ = search(
        cloud(100), 600, lambda scene, _: bytes(10 * len(scene) * (10 if len(scene) > 50 else 1))
    )
    assert 1 <= len(scene) <= 50


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".splat", ".ply"])
def test_prune_counts_bytes_of_the_format_that_is_named(tmp_path, suffix):
    scene = cloud(2000)
    small = prune_scene(scene, PruneOptions(f"0.02MB{suffix}", "opacity")).scene
    path = tmp_path / f"a{suffix}"
    format_to_write(path).write(small, path, lambda what, share: None)
    assert path.stat().st_size <= 20_000
    assert len(small) < 2000 or suffix == ".sog"


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_a_size_rounds_as_far_as_the_scene_has_errors_already(suffix):
    full = cloud(4000)
    limit = FileLimit(format_to_write(suffix), 32_000)

    def psnr_of(half: float, scene: Gaussians) -> float:
        """As of merging: ``half`` with half of the Gaussians, without end with all."""
        return half - 10 * math.log10(4000 / len(scene) - 1)

    found = {
        half: largest_within(
            full,
            lambda count: full[:count],
            limit,
            lambda share: None,
            functools.partial(psnr_of, half),
        )
        for half in (25.0, 35.0)
    }
    assert len(found[25.0][0]) > 1.1 * len(found[35.0][0])
    for half, (scene, rounded, _) in found.items():
        wanted = rounding_for(
            psnr_for_rounding(psnr_of(half, scene), len(scene) / 4000), full.sh_degree
        )
        assert rounded.rounding == pytest.approx(wanted)
        small = rounded.rounded(scene)
        assert len(small) == len(scene) and 0.9 * 32_000 < rounded.bytes_of(small) <= 32_000


@pytest.mark.parametrize("kept", [1e-9, 0.1, 0.5, 0.9, 1 - 1e-9])
def test_the_psnr_of_rounding_falls_by_the_slope_at_any_share(kept):
    """If the error of merging is A (kept^-p - 1), rounding goes by A kept^-p."""
    power = 10 ** (-SLOPE * math.log(kept) / 10)
    merged = 40 - 10 * math.log10(power - 1)
    assert psnr_for_rounding(merged, kept) == pytest.approx(40 + SLOPE * math.log(kept), abs=1e-5)
    assert psnr_for_rounding(merged, kept) < merged or kept < 1e-3


def test_a_scene_is_rounded_as_far_as_its_size_needs():
    scene = cloud(2000)
    kind = format_to_write(".spz")
    usual = 0.002
    size = FileLimit(kind, 10**9).bytes_of(kind.rounded(scene, usual))
    for most in (int(0.9 * size), size, int(1.05 * size)):
        found = FileLimit(kind, most, usual).bytes_of(FileLimit(kind, most, usual).rounded(scene))
        assert 0.94 * most < found <= most
    roomy = FileLimit(kind, int(1.5 * size), usual)
    assert size < roomy.bytes_of(roomy.rounded(scene)) <= roomy.most


def test_all_are_kept_unrounded_if_all_fit():
    full = cloud(500)
    limit = FileLimit(format_to_write(".sog"), 10**6)
    scene, unrounded, _ = largest_within(
        full, lambda count: full[:count], limit, lambda share: None
    )
    assert scene is full and unrounded.rounded(full) is full
    larger = cloud(1000, seed=1)  # as a repair may make one
    tight = FileLimit(limit.kind, limit.bytes_of(larger) * 4 // 5)
    assert tight.bytes_of(tight.rounded(larger)) <= tight.most
