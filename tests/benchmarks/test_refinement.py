"""The pure logic of benchmarks/refinement.py: statistics, pairing by seed, targets, what a file of rows takes up."""

from __future__ import annotations

import importlib
import json
import math
import sys
from pathlib import Path

import pytest

from pointsplat_ns.errors import PointSplatError

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def modules():
    """The benchmark's modules, which lie beside one another and in no package."""
    if not BENCHMARKS.is_dir():
        pytest.skip("benchmarks/ is not beside tests/")
    sys.path.append(str(BENCHMARKS))  # last: their short names hide nothing
    try:
        yield {name: importlib.import_module(name) for name in ("refinement", "refinement_report", "refinement_rows")}
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def report(modules):
    return modules["refinement_report"]


def row(scene="a", keep=0.1, start="paper", variant="selected", seed=None, photo=20.0, dense=20.0, **more) -> dict:
    values = {"photo_psnr": photo, "dense_psnr": dense, "count": 10, "steps": 5, "supervision": "dense"}
    return {"scene": scene, "keep": keep, "start": start, "variant": variant, "seed": seed} | values | more


def refined(scene, seed, photo, variant="dual", **more) -> dict:
    return row(scene, variant=variant, seed=seed, photo=photo, **more)


def test_the_spread_is_that_of_means_over_scenes_and_not_of_scenes(report):
    found = report.spread({0: {"a": 1.0, "b": 11.0}, 1: {"a": 2.0, "b": 12.0}, 2: {"a": 3.0, "b": 13.0}})
    assert (found.mean, found.deviation) == (7.0, 1.0)  # exact in binary
    assert found.error == pytest.approx(1 / math.sqrt(3))  # rounding of one root
    assert (found.smallest, found.smallest_at) == (1.0, ("a", 0))


def test_a_scene_that_a_seed_lacks_counts_for_no_seed_but_still_as_the_smallest(report):
    found = report.spread({0: {"a": 1.0, "b": -5.0}, 1: {"a": 2.0}})
    assert found.per_seed == {0: 1.0, 1: 2.0} and found.scenes == 1
    assert found.smallest_at == ("b", 0)
    assert report.spread({0: {"a": 1.0}, 1: {"b": 1.0}}) is None
    assert report.spread({}) is None
    assert report.spread({0: {"a": 1.0}}).deviation is None


def test_dual_minus_concat_pairs_seeds_and_scenes(report):
    # By seed dual is 1 dB better each time; paired otherwise, the differences would scatter by 10 dB.
    rows = [refined("a", s, 20 + 10 * s + 1) for s in (0, 1, 2)]
    rows += [refined("a", s, 20 + 10 * s, "concat") for s in (2, 1, 0)]
    rows += [refined("b", 0, 99.0), refined("a", 3, 99.0)]  # without a partner
    found = report.spread(report.versus_concat(report.Table(rows), ["a", "b"], [0.1], "paper", "photo_psnr"))
    assert found.per_seed == {0: 1.0, 1: 1.0, 2: 1.0}


def test_joined_budgets_keep_only_seeds_that_all_have(report):
    by = report.joined({0.1: {0: {"a": 1.0}, 1: {"a": 2.0}}, 0.3: {0: {"a": 3.0}}, 0.5: {}})
    assert by == {0: {"a 10 %": 1.0, "a 30 %": 3.0}}


def test_what_falls_back_is_counted(report):
    rows = [row(photo=20.0), refined("a", 0, 20.5)]
    rows += [refined("a", 0, 20.0, "as shipped", strength=0.0), refined("a", 1, 20.3, "as shipped", strength=0.5)]
    lines = dict(report.judge(report.Table(rows), {"unseen": ["a"]}))
    assert "1 of 2 fall back" in lines["all groups: as shipped nowhere worse than selected by more than 0.1 dB"]


@pytest.mark.parametrize(
    ("gain", "verdict"), [(2.25, "met by 0.25 dB"), (2.0, "met by 0.00 dB"), (1.5, "MISSED by 0.50 dB")]
)
def test_the_gain_target_is_met_from_its_value_on(report, gain, verdict):
    rows = [row(photo=20.0)] + [refined("a", seed, 20 + gain) for seed in (0, 1, 2)]
    lines = dict(report.judge(report.Table(rows), {"unseen": ["a"]}))
    assert lines["unseen, paper at 10 %: dual beats selected by 2 dB"].startswith(verdict)
    assert lines["unseen, paper at 30 %: dual beats selected by 1 dB"] == "no data"


def test_targets_of_quality_look_at_unseen_scenes_alone_and_nowhere_worse_at_all(report):
    rows = [row("a"), row("b"), refined("a", 0, 23.0), refined("b", 0, 19.5)]
    lines = dict(report.judge(report.Table(rows), {"kitchen": ["b"], "unseen": ["a"]}))
    assert lines["unseen, paper at 10 %: dual beats selected by 2 dB"].startswith("met by 1.00 dB: +3.00 dB")
    nowhere = lines["all groups: dual nowhere worse than selected by more than 0.1 dB"]
    assert nowhere.startswith("MISSED by 0.40 dB, 1 of 2 cases below (worst -0.50 dB: b paper 10 % seed 0)")


@pytest.mark.parametrize(
    ("differences", "verdict"),
    [
        ((1.0, 1.1, 0.9), "met"),
        ((-1.0, -1.1, -0.9), "MISSED"),
        ((1.0, -1.0, 0.3), "UNDECIDED"),
        ((0.5,), "positive, one seed alone"),
        ((0.0, 0.0, 0.0), "MISSED"),  # equal is not better, and there is no spread to divide by
    ],
)
def test_dual_beats_concat_only_by_more_than_the_spread_of_seeds(report, differences, verdict):
    rows = [refined("a", seed, 20 + value) for seed, value in enumerate(differences)]
    rows += [refined("a", seed, 20.0, "concat") for seed in range(len(differences))]
    lines = dict(report.judge(report.Table(rows), {"unseen": ["a"]}))
    assert lines["unseen, paper at 10 %: dual beats concat"].startswith(verdict)


def test_rows_of_several_files_are_read_together_and_unlike_settings_refused(report, tmp_path):
    for name, scene, views in (("one", "a", 8), ("two", "b", 8), ("other", "c", 4)):
        text = json.dumps({"settings": {"views": views}, "rows": [row(scene)]})
        (tmp_path / f"{name}.json").write_text(text)
    rows, _ = report.read_files([tmp_path / "one.json", tmp_path / "two.json", tmp_path / "one.json"])
    assert [r["scene"] for r in rows] == ["a", "b"]
    with pytest.raises(PointSplatError, match="other.json: made with"):
        report.read_files([tmp_path / "one.json", tmp_path / "other.json"])
    with pytest.raises(PointSplatError, match="gone.json: not a file of rows"):
        report.read_files([tmp_path / "gone.json"])


def test_a_file_of_rows_takes_up_what_it_has_and_replaces_what_is_of_other_weights(modules, tmp_path):
    rows_of = modules["refinement_rows"].Rows
    path = tmp_path / "deep" / "rows.json"
    first = rows_of(path, {"views": 8})
    first.add(refined("a", 0, 20.0, weights="old"))
    first.add(refined("a", 1, 21.0, weights="old"))
    again = rows_of(path, {"views": 8})
    key = {"scene": "a", "keep": 0.1, "start": "paper", "variant": "dual", "seed": 0, "weights": "old"}
    assert again.has(key) and not again.has(key | {"weights": "new"})
    again.add(refined("a", 0, 22.0, weights="new"))
    known = {r["seed"]: r["photo_psnr"] for r in rows_of(path, {"views": 8}).rows}
    assert known == {0: 22.0, 1: 21.0}
    assert [p.name for p in path.parent.iterdir()] == ["rows.json"]
    with pytest.raises(PointSplatError, match="name another file"):
        rows_of(path, {"views": 4})


def test_a_training_of_another_command_is_not_taken_for_this_one(modules, tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "x.command").write_text("ns-train pointsplat --max-num-iterations 5")
    with pytest.raises(PointSplatError, match="is of another command"):
        modules["refinement"]._train_one(tmp_path, "x", "ns-train pointsplat --max-num-iterations 6", 6, None)


def test_groups_name_scenes_that_are_there(report, capsys):
    table = report.Table([row("a"), row("b", seen=True)])
    assert report.parse_groups(["unseen=a,z", "other=b"], table) == {"unseen": ["a"], "other": ["b"]}
    assert "not in the files: z" in capsys.readouterr().out
    with pytest.raises(PointSplatError, match="no such scene"):
        report.parse_groups(["kitchen=k"], table)
    assert report.default_groups(table.rows) == {"unseen": ["a"], "seen": ["b"]}
