"""lab/training/with_photos.py: which ways are measured, for how long each, and what the record says."""

import json
import time

import pytest

from lab.training import with_photos as program
from lab.training.score_and_train import CpuBudget
from lab.training.with_photos import COMPACTED, DENSE, METHODS, SCORES


def row(keep: float, method: str, psnr: float = 25.0, seconds: float = 60.0, scene: str = "fox"):
    return {
        **{"scene": scene, "at": "photos", "keep": keep, "method": method, "count": round(1000 * keep), "photos": 5},
        **{"width": 360, "height": 640, "steps": 2000, "cpu_seconds": seconds, "psnr": psnr, "ssim": 0.9},
        "needs_dense": method != DENSE,
    }


class Tried(program.Capture):
    """A capture of which nothing is trained."""

    def __init__(self, folder):
        super().__init__("fox", ["splatfacto-cpu", "--data", "fox"], 2000, folder, None)
        self.asked: list[tuple] = []

    def train(self):
        return self.folder, 1010.0

    def reduced(self, words, count):
        self.asked.append((*words[3:], count))
        return self.folder, 60.0

    def row(self, keep, method, scene, seconds, with_dense):
        assert scene == self.folder
        return row(keep, method, seconds=seconds) | {"needs_dense": with_dense}


def test_all_ways_are_measured_and_scores_train_as_long_as_compact(tmp_path):
    capture = Tried(tmp_path)
    rows = list(program.measured(capture, (0.1,), []))
    assert [found["method"] for found in rows] == list(METHODS) and rows[0]["cpu_seconds"] == 1010
    assert ("compact", "--photos", 100) in capture.asked
    assert ("compact", "--photos", "--seconds", "1010", 100) in capture.asked
    assert ("lightgaussian", "60.0", 100) in capture.asked and ("pup", "60.0", 100) in capture.asked
    assert [found["needs_dense"] for found in rows] == [False] + [True] * 6


def test_training_on_photos_ends_when_it_has_used_its_cpu_seconds():
    budget = CpuBudget(cpu_seconds=200.0, started=time.process_time() - 100)
    assert budget.share_done(3, 0.0) == pytest.approx(0.5, abs=0.05) and not budget.empty
    assert CpuBudget(cpu_seconds=0.0).empty


ROWS = [
    *(row(1.0, DENSE, 30.0, 700.0, scene) for scene in ("fox", "vr_project")),
    *(row(0.1, COMPACTED, psnr, 60.0, scene) for scene, psnr in (("fox", 28.0), ("vr_project", 27.0))),
    row(0.1, SCORES["pup"], 26.5),
]


def test_the_record_is_written_and_gives_the_same_page_again(tmp_path):
    (tmp_path / "found.json").write_text(json.dumps({"settings": {"lpips": False}, "rows": ROWS}))
    program.main(write_from=(tmp_path / "found.json",), record=tmp_path)
    page = (tmp_path / "with_photos.md").read_text()
    assert page == program.page(ROWS) and "| dense | -2.50 (-3.00 to -2.00), 2 |" in page
    assert "| PUP-3DGS, trained on | +1.50 (+1.50 to +1.50), 1 |" in page
    program.main(write_from=(tmp_path / "with_photos.json",), record=tmp_path)
    assert (tmp_path / "with_photos.md").read_text() == page
