"""A share of the slider is there at once by a score, and merged once a page waits for it."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import torch

import pointsplat_ns as ps
from making import ball, same
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.tools.pages import slider_scenes as module
from pointsplat_ns.tools.pages.slider_scenes import ViewedScene

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return ball(400)


@pytest.fixture()
def levels(scene) -> Iterator[ViewedScene]:
    made = ViewedScene("ball", None, scene, ViewProvider(scene))
    yield made
    made.close(5.0)


def test_levels_of_a_stream_stand_for_their_shares_and_are_not_merged(scene, tmp_path, monkeypatch):
    ps.lod(scene, [1.0, 0.5, 0.1], folder=tmp_path / "room", stream=True)
    shown = []
    monkeypatch.setattr(
        "pointsplat_ns.tools.pages.viewer.Viewer", lambda scenes, *rest: shown.extend(scenes)
    )
    ps.open_viewer(tmp_path / "room")
    (made,) = shown
    for percent, how in (
        (50, "level 1 of the stream"),
        (10, "level 2 of the stream"),
        (30, "chosen by coverage"),
    ):
        level = made.at(percent)
        assert level.how == how and made.ready(percent) is (None if percent == 30 else level)
        assert len(level.scene) == pytest.approx(percent * len(made.scene) / 100, rel=0.1)
    made.close(5.0)


def test_a_share_is_there_at_once_by_coverage_and_then_merged(levels, scene):
    for percent in (1, 20):
        level = levels.at(percent)
        assert same(level.scene, ps.prune(scene, percent / 100, by="coverage"))
        assert level.how == "chosen by coverage" and levels.ready(percent) is None
    assert same(levels.merged(20).scene, ps.prune(scene, "20%"))
    assert levels.at(20) is levels.ready(20) and levels.at(20).how == "merged"
    assert same(levels.at(100).scene, scene) and levels.merged(100) is levels.whole


def test_merging_is_stopped_by_the_choice_of_another_share(levels, endless, monkeypatch):
    (begun, _) = endless
    found = []
    page = threading.Thread(target=lambda: found.append(levels.merged(30)))
    page.start()
    assert begun.wait(30)
    levels.stop()
    page.join(30)
    assert found == [None] and levels.ready(30) is None
    monkeypatch.setattr(
        module.Merger, "merged", lambda _, count, progress: SimpleNamespace(scene=ball(count))
    )
    assert len(levels.merged(10).scene) == 40


def test_failed_merging_leaves_what_was_chosen_and_says_why(levels, monkeypatch):
    def fails(*args, **options):
        raise ps.BudgetError("no such thing")

    monkeypatch.setattr(module.Merger, "merged", fails)
    level = levels.merged(50)
    assert "no such thing" in level.how and len(level.scene) == 200


def test_merged_levels_together_take_no_more_than_the_scene(levels, monkeypatch):
    monkeypatch.setattr(
        module.Merger, "merged", lambda _, count, progress: SimpleNamespace(scene=ball(count))
    )
    for percent in (40, 50, 60):
        levels.merged(percent)
    assert [levels.ready(percent) is None for percent in (40, 50, 60)] == [True, True, False]


def test_gaussians_that_cannot_be_drawn_are_left_out(scene):
    broken = scene.replace(means=scene.means.index_fill(0, torch.tensor([0, 7]), torch.nan))
    made = ViewedScene("ball", None, broken, ViewProvider(broken))
    made.close(5.0)
    assert len(made.scene) == 398
