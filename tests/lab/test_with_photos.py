"""lab/training/with_photos.py: which ways are measured, for how long each, and what the record
says."""

import time

import pytest

from lab.judge.record import FOLDER
from lab.training import with_photos as program
from lab.training.score_and_train import CpuBudget
from lab.training.with_photos import METHODS

pytestmark = pytest.mark.usefixtures("quick")


class Tried(program.Capture):
    """A capture of which nothing is trained."""

    def __init__(self, folder):
        super().__init__("fox", ["splatfacto-cpu", "--data", "fox"], 2000, folder, None)
        self.asked: list[tuple] = []

    def train(self):
        return self.folder, 1010.0

    def reduced(self, program, count, options):
        self.asked.append((*program[3:], count, *options))
        return self.folder, 60.0

    def row(self, keep, method, scene, seconds, with_dense):
        assert scene == self.folder
        known = {"keep": keep, "method": method, "count": round(1000 * keep)}
        return {**known, "cpu_seconds": seconds, "needs_dense": with_dense}


def test_all_ways_are_measured_and_scores_train_as_long_as_compact(tmp_path):
    capture = Tried(tmp_path)
    rows = list(program.measured(capture, (0.1,), []))
    assert [found["method"] for found in rows] == list(METHODS) and rows[0]["cpu_seconds"] == 1010
    assert ("compact", 100, "--photos") in capture.asked
    assert ("compact", 100, "--photos", "--seconds", "1010") in capture.asked
    assert ("lightgaussian", "60.0", 100) in capture.asked and ("pup", "60.0", 100) in capture.asked
    assert [found["needs_dense"] for found in rows] == [False] + [True] * 6


def test_training_on_photos_ends_when_it_has_used_its_cpu_seconds():
    budget = CpuBudget(cpu_seconds=200.0, started=time.process_time() - 100)
    assert budget.share_done(3, 0.0) == pytest.approx(0.5, abs=0.05) and not budget.empty
    assert CpuBudget(cpu_seconds=0.0).empty


def test_the_record_is_written_from_its_rows(tmp_path):
    program.main(write_from=(FOLDER / "with_photos.json",), record=tmp_path)
    for name in ("with_photos.json", "with_photos.md"):
        assert (tmp_path / name).read_text("utf-8") == (FOLDER / name).read_text("utf-8")
