"""The measurement of networks of repairs."""

import json

import pytest
import torch

from lab.judge import repairs
from lab.judge.repairs import ADAM, MERGED, SHIPPED, SharedExamples, each_scene, lines, repaired
from lab.judge.scenes import JudgedScene, Look
from pointsplat_ns.pipeline import repair_budget
from pointsplat_ns.pipeline.repair import repair
from pointsplat_ns.pipeline.repair_budget import RepairBudget
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import prune
from pointsplat_ns.refinement.feedback import FeedbackRefiner, shipped_feedback_refiner

pytestmark = pytest.mark.usefixtures("quick")


def test_its_steps_are_those_of_a_repair_to_the_bit(hollow_ball, monkeypatch):
    monkeypatch.setitem(repair_budget.STEPS, "quick", 4)
    small = prune(hollow_ball, 60, "merge")
    resolution = (64, 36)
    expected = repair(
        small,
        hollow_ball,
        ViewProvider(hollow_ball, resolution=resolution),
        RepairBudget(),
        psnr=37.0,
    )
    assert expected.steps == 4
    examples = SharedExamples(hollow_ball, ViewProvider(hollow_ball, resolution=resolution))
    assert examples.draw(4) > 0
    network = shipped_feedback_refiner(torch.device("cpu"))
    found = repaired(small, len(hollow_ball), examples, 4, network, 37.0)
    for mine, theirs in zip(found.tensors(), expected.scene.tensors(), strict=True):
        assert torch.equal(mine, theirs)


def test_rows_of_each_way_are_measured_once_and_stand_in_the_page(hollow_ball, ball_views):
    scene = JudgedScene("ball", hollow_ball, (Look(64, ball_views),), "abc")
    ways = {SHIPPED: shipped_feedback_refiner(torch.device("cpu")), ADAM: None}
    rows = [*repairs.measured(scene, 0.1, ways, (2,))]
    assert [(row["steps"], row["way"]) for row in rows] == [(0, MERGED), (2, SHIPPED), (2, ADAM)]
    assert all(row["cpu_seconds"] > 0 for row in rows[1:])
    more = {**ways, "new": FeedbackRefiner()}
    new = [*repairs.measured(scene, 0.1, more, (2,), rows)]
    assert [row["way"] for row in new] == ["new"]
    assert new[0]["psnr"] == rows[2]["psnr"], "an untrained network gives plain Adam"
    assert not [*repairs.measured(scene, 0.1, more, (2,), rows + new)]
    page = repairs.page(rows + new, "repairs.json", 4, 64)
    gain = rows[1]["psnr"] - rows[0]["psnr"]
    assert f"| 2 | shipped | {rows[1]['psnr']:.2f} | {gain:+.2f} | {gain:+.2f} (ball) | - |" in page
    assert each_scene(rows).endswith(f"| {rows[1]['psnr']:.2f} | {rows[2]['psnr']:.2f} |")


def test_the_worst_scene_is_the_one_that_gains_least_over_the_shipped_network():
    rows = json.loads(
        """[
        {"scene": "a", "steps": 0, "way": "merged", "psnr": 20.0, "cpu_seconds": 0},
        {"scene": "b", "steps": 0, "way": "merged", "psnr": 30.0, "cpu_seconds": 0},
        {"scene": "a", "steps": 48, "way": "shipped", "psnr": 21.0, "cpu_seconds": 2},
        {"scene": "b", "steps": 48, "way": "shipped", "psnr": 32.0, "cpu_seconds": 4},
        {"scene": "a", "steps": 48, "way": "new", "psnr": 21.5, "cpu_seconds": 2},
        {"scene": "b", "steps": 48, "way": "new", "psnr": 31.9, "cpu_seconds": 3}
        ]"""
    )
    assert lines(rows) == [
        ["48", "shipped", "26.50", "+1.50", "+1.00 (a)", "-", "3.0"],
        ["48", "new", "26.70", "+1.70", "-0.10 (b)", "+0.20", "2.5"],
    ]
