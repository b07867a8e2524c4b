"""benchmarks/compaction.py: what it measures of a small scene, its tables, and a run that is taken up again."""

from __future__ import annotations

import json
import math
import re
import types
from pathlib import Path

import pytest
import torch

from making import box_room
from peers import peer
from pointsplat_ns import View, sample_views
from pointsplat_ns.io import write_ply
from pointsplat_ns.metrics import MOST_PSNR


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scenes") / "small.ply"
    write_ply(box_room(seed=3), path)
    return path


@pytest.fixture(scope="module")
def compaction(benchmark):
    return benchmark("compaction")


@pytest.fixture(scope="module")
def tables(benchmark):
    return benchmark("compaction_tables")


def test_every_program_and_mode_is_a_row(compaction, room, tmp_path, capsys):
    results = tmp_path / "rows.json"
    options = {"keep": (0.5,), "methods": ("merge",), "views": 2, "lpips": False, "json_path": results}
    options["splat_transform"] = (peer(tmp_path, "3.7.0"), peer(tmp_path, "2.7.1"))
    compaction.main((room,), **options)
    said = capsys.readouterr().out
    labels = ["merge", "splat-transform 3.7.0 -d", "splat-transform 3.7.0 adaptive", "splat-transform 2.7.1"]
    content = json.loads(results.read_text())
    assert [row["method"] for row in content["rows"]] == labels
    assert all(label in said for label in labels)
    by = {row["method"]: row for row in content["rows"]}
    for row in by.values():
        assert row["count"] == 450 and row["gaussians"] == 900
        assert row["peak_bytes"] > 5e6 and row["seconds"] > 0 and row["cpu_seconds"] > 0
        assert row["dense_near_psnr"] is not None and row["dense_far_psnr"] is not None
    assert by[labels[1]]["dense_psnr"] == by[labels[3]]["dense_psnr"] != by[labels[2]]["dense_psnr"]
    (lead,) = content["leads"]
    assert lead["dense_psnr"] == by["merge"]["dense_psnr"] - max(by[label]["dense_psnr"] for label in labels[1:])
    assert "merge minus the best mode" in said and "held-out photos" not in said


def test_scenes_that_a_file_has_are_not_measured_again_unless_they_changed(compaction, tmp_path, capsys):
    first, second, results = tmp_path / "first.ply", tmp_path / "second.ply", tmp_path / "rows.json"
    options = {"keep": (0.5,), "methods": ("random",), "in_process": True, "views": 1, "lpips": False}
    options |= {"json_path": results, "splat_transform": (peer(tmp_path, "2.7.1"),)}

    def main(*scenes: Path, **changes) -> list[dict]:
        compaction.main(scenes, **{**options, **changes}, resume=True)
        return json.loads(results.read_text())["rows"]

    write_ply(box_room(seed=3), first)
    write_ply(box_room(seed=4), second)
    alone = main(first)
    assert [row["method"] for row in alone] == ["random", "splat-transform 2.7.1"]
    assert alone[0]["peak_bytes"] is None and alone[0]["cpu_seconds"] is not None and alone[0]["count"] == 450
    both = main(first, second)
    assert both[:2] == alone and [row["scene"] for row in both] == ["first", "first", "second", "second"]
    assert f"first: as {results} has it" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=re.escape("was written with keep [0.5], now [0.3]")):
        main(first, second, keep=(0.3,))
    write_ply(box_room(seed=3, count=600, size=0.2), first)
    changed = main(first, second)
    assert [row["gaussians"] for row in changed if row["scene"] == "first"] == [600, 600]
    assert [row for row in changed if row["scene"] == "second"] == both[2:]


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"rows": []}'])
def test_a_file_that_is_not_of_this_benchmark_is_not_taken_up(compaction, tmp_path, text):
    path = tmp_path / "rows.json"
    path.write_text(text)
    with pytest.raises(SystemExit, match="cannot be taken up"):
        compaction.Results(path, {}, resume=True)
    assert path.read_text() == text


def test_what_cannot_be_run_is_an_error_at_the_start(compaction, room, tmp_path):
    with pytest.raises(SystemExit, match="FileNotFoundError"):
        compaction.main((room,), splat_transform=(str(tmp_path / "nothing"),))
    known = {"splat_transform": (peer(tmp_path, "2.7.1"),)}
    with pytest.raises(SystemExit, match="two scenes have one name"):
        compaction.main((room, room), **known)
    with pytest.raises(SystemExit, match="no scene named"):
        compaction.main((), **known)
    with pytest.raises(SystemExit, match="--resume without --json"):
        compaction.main((room,), **known, lpips=False, resume=True)


def test_scaling_measures_each_program_at_each_size(compaction, tmp_path, capsys):
    results = tmp_path / "scaling.json"
    programs = (peer(tmp_path, "2.7.1"),)
    compaction.main(scaling=True, gaussians=(2000,), sh_degree=1, json_path=results, splat_transform=programs)
    content = json.loads(results.read_text())
    assert [row["method"] for row in content["rows"]] == ["merge", "splat-transform 2.7.1"] * 2
    assert [(row["gaussians"], row["count"]) for row in content["rows"][::2]] == [(1000, 100), (2000, 200)]
    assert [row["file_bytes"] // row["gaussians"] for row in content["rows"]] == [104] * 4  # 26 floats
    assert [found["method"] for found in content["slopes"]] == ["merge", "splat-transform 2.7.1"]
    assert "slope of log time" in capsys.readouterr().out


def test_a_size_that_does_not_fit_is_left_out_with_the_reason(benchmark, monkeypatch):
    scaling, processes = benchmark("scaling"), benchmark("processes")
    copy = processes.Reducer("copy", lambda source, count, target: ["cp", str(source), str(target)])
    monkeypatch.setattr(scaling.shutil, "disk_usage", lambda folder: types.SimpleNamespace(total=10**9, free=10**6))
    start, large = scaling.scaling_rows((10_000,), 3, [copy])
    assert start["failed"] == "" and start["count"] == scaling.START
    assert large["failed"] == "about 0.00273 GB of disk needed, 0.001 GB free" and large["seconds"] is None


def test_scores_are_timed(capsys, benchmark):
    benchmark("scaling").print_score_times(500, 0)
    assert {"paper", "opacity"} <= {line.split()[0] for line in capsys.readouterr().out.splitlines()}


@pytest.fixture()
def scene(benchmark):
    """A room seen from within."""
    held_out, dense = benchmark("held_out"), box_room(seed=3)
    views = sample_views(dense, 2, width=48, height=36)
    renders = [held_out.render(dense, view) for view in views]
    nearer = [held_out.nearer_half(dense, view) for view in views]
    return held_out.Scene("room", dense, views, renders, None, nearer)


def test_near_and_far_split_the_pixels_of_each_view_in_two_at_the_median_depth(scene):
    for nearer in scene.nearer:
        assert nearer.shape == (36, 48)
        assert float(nearer.float().mean()) == pytest.approx(0.5, abs=2 / nearer.numel())  # the median's own pixel


def test_a_fault_in_the_nearer_half_shows_there_alone(scene, benchmark, monkeypatch):
    held_out = benchmark("held_out")
    drawn = iter(zip(scene.renders, scene.nearer, strict=True))

    def darker_near(small, view):
        image, nearer = next(drawn)
        return image.double() - 0.1 * nearer[..., None]

    monkeypatch.setattr(held_out, "render", darker_near)
    scene.renders = [image.double() for image in scene.renders]
    scene_found = held_out.compare(scene, scene.dense, None)
    share = torch.stack(scene.nearer).double().mean()
    assert scene_found["dense_near_psnr"] == pytest.approx(20.0)  # -10 log10(0.1^2), float64
    assert scene_found["dense_far_psnr"] == MOST_PSNR
    assert scene_found["dense_brightness"] == pytest.approx(-25.5 * float(share))
    assert scene_found["dense_psnr"] == pytest.approx(20 - 10 * math.log10(float(share)), abs=0.01)  # views' means


def test_a_view_of_nothing_has_no_nearer_half(benchmark):
    held_out = benchmark("held_out")
    dense = box_room(seed=3, count=30)
    behind = torch.eye(4, dtype=torch.float64)
    behind[2, 3] = -100.0
    K = torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]], dtype=torch.float64)
    view = View(behind, K, 16, 12, torch.zeros(3))
    nearer = held_out.nearer_half(dense, view)
    assert nearer.shape == (12, 16) and not nearer.any()
    image = held_out.render(dense, view)
    small = dense[:5]
    found = held_out.compare(held_out.Scene("", dense, [view], [image], None, [nearer]), small, None)
    assert found["dense_near_psnr"] is None and found["dense_far_psnr"] == MOST_PSNR


def row(scene: str, method: str, psnr: float, photo: float | None = None, keep: float = 0.1) -> dict:
    return {"scene": scene, "keep": keep, "method": method, "dense_psnr": psnr, "photo_psnr": photo, "count": 5}


def test_no_scene_is_both_tuned_on_and_judged(tables):
    assert not {*tables.TUNING} & {*tables.JUDGED}
    assert [tables.group_of(name) for name in ("fox", "lounge", "mine")] == ["tuning", "judged", ""]


def test_means_are_taken_apart_by_group_with_the_scene_that_loses_most(tables):
    rows = [row("rock", "merge", 30.0, 20.0), row("lounge", "merge", 20.0), row("fox", "merge", 10.0)]
    judged, tuning = tables.averages(rows)
    assert (judged["scene"], judged["dense_psnr"], judged["photo_psnr"]) == ("mean of 2 judged", 25.0, 20.0)
    assert (judged["worst"], judged["worst_scene"]) == (20.0, "lounge")
    assert (tuning["scene"], tuning["dense_psnr"], tuning["photo_psnr"]) == ("mean of 1 tuning", 10.0, None)


def test_the_lead_is_over_the_best_mode_of_each_scene_budget_and_reference(tables):
    a, b = "splat-transform 3.7.0 -d", "splat-transform 2.7.1"
    rows = [row("rock", "merge", 30.0, 25.0), row("rock", a, 29.0, 23.0), row("rock", b, 28.0, 25.5)]
    rows += [row("rock", "coverage", 99.0), row("lounge", "merge", 20.0), row("lounge", b, 20.5)]
    rows += [row("lounge", "merge", 30.0, keep=0.5), row("cake_fraisier", b, 30.0)]
    first, second = tables.leads(rows)
    assert (first["dense_psnr"], first["dense_psnr_peer"]) == (1.0, a)
    assert (first["photo_psnr"], first["photo_psnr_peer"]) == (-0.5, b)
    assert (second["scene"], second["dense_psnr"]) == ("lounge", -0.5) and "photo_psnr" not in second
    lines = {name: (values, beside) for name, values, beside in tables.summary([first, second], "dense_psnr")}
    assert lines["judged mean"] == ({0.1: 0.25}, {})
    assert lines["judged worst"] == ({0.1: -0.5}, {0.1: "lounge"})
    assert lines["rock"] == ({0.1: 1.0}, {0.1: "3.7.0 -d"})
    assert [*tables.summary([second], "photo_psnr")] == []
    assert tables.lead_table([second], "photo_psnr") is None


def test_the_slope_is_the_exponent(benchmark):
    slope = benchmark("scaling").slope
    counts = [100_000, 300_000, 1_000_000, 10_000_000]
    assert slope(counts, [1e-5 * n**1.25 for n in counts]) == pytest.approx(1.25, abs=1e-9)
    assert slope(counts, [1e-300 * n for n in counts]) == pytest.approx(1.0, abs=1e-9)
    assert slope(counts, [1e290 * n for n in counts]) == pytest.approx(1.0, abs=1e-9)
    assert slope(counts, [0.0, -1.0, 2.0, 20.0]) == pytest.approx(1.0)  # not positive: no time that can be told
    assert slope(counts[:1], [1.0]) is None and slope([5, 5], [1.0, 2.0]) is None and slope([], []) is None


def test_slopes_beyond_the_start_leave_out_what_starting_takes(benchmark):
    scaling = benchmark("scaling")
    rows = [
        {"method": "merge", "gaussians": n, "seconds": 5.0 + s, "cpu_seconds": 5.0 + s}
        for n, s in ((scaling.START, 0.0), (10_000, 1.0), (100_000, 10.0))
    ]
    rows.append({"method": "merge", "gaussians": 10**6, "seconds": None, "cpu_seconds": None})  # left out
    (found,) = scaling.slopes(rows)
    assert found["seconds_beyond_start"] == pytest.approx(1.0)
    assert found["seconds"] == pytest.approx(math.log10(15 / 6))
