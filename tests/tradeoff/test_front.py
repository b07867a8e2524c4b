"""Which points are on the front, and which one is recommended."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pointsplat_ns.tradeoff.front import fastest_above, fastest_within, pareto_front
from pointsplat_ns.tradeoff.points import Point, Quality


def point(key: str, ms: float, renders: float, photos: float | None, size: int = 100) -> Point:
    return Point(
        key=key,
        label=key,
        command="" if key == "dense" else f"pointsplat prune room.ply -o {key}.ply",
        by="dense" if key == "dense" else "merge",
        share=size / 100,
        gaussians=size,
        sh_degree=3,
        repair="none",
        bytes=size,
        against_dense=Quality(renders, 1 - 1 / renders),
        against_photos=None if photos is None else Quality(photos, 1 - 1 / photos, 1 / photos),
        frame_ms=ms,
        frame_ms_low=ms,
        frame_ms_high=ms,
        seconds=1.0,
    )


POINTS = [
    point("dense", 100, math.inf, 30.1),
    point("half", 60, 42.0, 30.0, 50),
    point("slow", 70, 35.0, 29.9, 60),  # beaten by half in everything
    point("third", 40, 36.0, 29.6, 30),
    point("tenth", 20, 30.0, 28.0, 10),
]


def keys(points):
    return [p.key for p in points]


@pytest.mark.parametrize("cost", ["frame_ms", "gaussians", "bytes"])
@pytest.mark.parametrize(("reference", "metric"), [("renders", "psnr"), ("photos", "ssim"), ("photos", "lpips")])
def test_front_is_what_nothing_beats_cheapest_first(cost, reference, metric):
    assert keys(pareto_front(POINTS, cost, reference, metric)) == ["tenth", "third", "half", "dense"]


def test_front_takes_the_better_of_two_that_cost_the_same_and_the_first_of_two_equal_ones():
    better = replace(POINTS[4], key="better", against_dense=Quality(31.0, 0.97))
    again = replace(POINTS[4], key="again")
    assert keys(pareto_front([*POINTS, again], "bytes", "renders", "psnr"))[0] == "tenth"
    assert keys(pareto_front([*POINTS, better], "bytes", "renders", "psnr"))[0] == "better"
    assert "tenth" not in keys(pareto_front([*POINTS, better], "bytes", "renders", "psnr"))


def test_front_leaves_out_points_without_the_metric():
    assert pareto_front(POINTS, "bytes", "renders", "lpips") == []
    unknown = replace(POINTS[4], against_dense=Quality(math.nan, 0.9))
    assert keys(pareto_front([*POINTS[:4], unknown], "bytes", "renders", "psnr")) == ["third", "half", "dense"]


@pytest.mark.parametrize(("db", "key"), [(0.0, "dense"), (0.1, "half"), (0.49, "half"), (0.5, "third"), (3.0, "tenth")])
def test_recommended_is_the_fastest_that_loses_no_more_than_asked(db, key):
    assert fastest_within(POINTS, db).key == key


@pytest.mark.parametrize(("db", "key"), [(43, "dense"), (42, "half"), (35, "third"), (30, "tenth")])
def test_recommended_without_photos_is_the_fastest_that_is_close_enough_to_the_dense_scene(db, key):
    assert fastest_above(POINTS, db).key == key


def test_nothing_is_recommended_by_photos_that_are_not_there():
    assert fastest_within([replace(p, against_photos=None) for p in POINTS], 0.5) is None


def test_of_two_as_fast_the_smaller_is_recommended():
    twin = replace(POINTS[3], key="twin", bytes=20)
    assert fastest_above([*POINTS, twin], 35).key == "twin"


def test_where_times_are_not_to_be_trusted_the_fewest_gaussians_are_recommended():
    slow = replace(POINTS[1], key="few", frame_ms=1e6, gaussians=1)
    assert fastest_within([*POINTS, slow], 100, trusted=False).key == "few"
    assert fastest_within([*POINTS, slow], 100).key != "few"
