"""A budget acts at once by a score, and is merged once it stays."""

import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
import torch

import pointsplat_ns as ps
from making import ball, same
from pointsplat_ns.compression.level_stream import Chunks
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pages import selection as module
from pointsplat_ns.pages.kept import Selection


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return ball(400)


class News:
    """Counts changes, and waits for what shall come of them."""

    def __init__(self) -> None:
        self.changed = threading.Condition()

    def __call__(self, picture: bool) -> None:
        with self.changed:
            self.changed.notify_all()

    def wait(self, until: Callable[[], bool]) -> None:
        with self.changed:
            assert self.changed.wait_for(until, 30)


@pytest.fixture()
def news() -> News:
    return News()


@pytest.fixture()
def selection(scene, news) -> Iterator[Selection]:
    made = Selection(scene, ViewSource(scene), news, rest=0.01)
    yield made
    made.close()


@pytest.fixture()
def patient(scene, news) -> Iterator[Selection]:
    """It does not merge while a test lasts."""
    made = Selection(scene, ViewSource(scene), news, rest=1000.0)
    yield made
    made.close()


def test_levels_of_a_stream_stand_for_their_shares_and_are_not_merged(scene, tmp_path, monkeypatch):
    ps.lod(scene, [1.0, 0.5, 0.1], folder=tmp_path / "room", stream=Chunks())
    shown = []
    monkeypatch.setattr("pointsplat_ns.pages.viewer.Viewer", lambda scenes, *rest: shown.extend(scenes))
    ps.open_viewer(tmp_path / "room")
    (viewed,) = shown
    made = Selection(viewed.scene, viewed.source, lambda picture: None, rest=0.0, levels=viewed.levels)
    try:
        for percent, how in ((50, "level 1 of the stream"), (10, "level 2 of the stream"), (30, "chosen by coverage")):
            made.choose(percent)
            assert made.current.how == how
            assert len(made.current.scene) == pytest.approx(percent * len(viewed.scene) / 100, rel=0.1)
    finally:
        made.close()


@pytest.mark.parametrize("percent", [1, 10, 77, 99])
def test_budget_acts_at_once_by_coverage(patient, scene, percent):
    patient.choose(percent)
    assert same(patient.current.scene, ps.prune(scene, percent / 100, by="coverage"))
    assert patient.current.how == "chosen by coverage"


def test_budget_that_stays_is_merged_as_prune_does(selection, scene, news):
    selection.choose(20)
    news.wait(lambda: selection.current.how == "merged")
    assert same(selection.current.scene, ps.prune(scene, "20%"))
    assert selection.status == ""
    selection.choose(100)
    assert same(selection.current.scene, scene)
    selection.choose(20)
    assert selection.current.how == "merged", "it is kept"


def test_merging_is_stopped_by_another_budget(selection, scene, news, monkeypatch):
    stopped, begun = threading.Event(), threading.Event()

    def slow(merger, count, progress):
        try:
            while True:
                begun.set()
                progress(0.5)
        except BaseException:
            stopped.set()
            raise

    monkeypatch.setattr(module.Merger, "merged", slow)
    selection.choose(30)
    assert begun.wait(30)
    news.wait(lambda: selection.status == "merging, 50 %")
    monkeypatch.setattr(module.Merger, "merged", lambda merger, count, progress: SimpleNamespace(scene=scene[:count]))
    selection.choose(10)
    assert stopped.wait(30)
    news.wait(lambda: selection.current.how == "merged")
    assert len(selection.current.scene) == 40


def test_failed_merge_leaves_what_was_chosen_and_says_why(selection, news, monkeypatch):
    def fails(*args, **options):
        raise ps.BudgetError("no such thing")

    monkeypatch.setattr(module.Merger, "merged", fails)
    selection.choose(50)
    news.wait(lambda: "no such thing" in selection.current.how)
    assert len(selection.current.scene) == 200


def test_gaussians_that_cannot_be_drawn_are_left_out(scene, news):
    broken = scene.replace(means=scene.means.index_fill(0, torch.tensor([0, 7]), torch.nan))
    made = Selection(broken, ViewSource(broken), news)
    made.close()
    assert len(made.scene) == 398


def test_parts_for_moving_cameras_cover_as_much(scene, news):
    made = Selection(scene, ViewSource(scene), news)
    made.close()
    part = made.current.part(0.3, least=50)
    assert 50 <= len(part) <= 120 and made.current.part(0.31, least=50) is part
    assert made.current.part(1.0) is made.current.scene

    def area(some: ps.Gaussians) -> float:
        return float(some.stds.square().sum())

    assert area(part) == pytest.approx(area(scene), rel=0.3)
