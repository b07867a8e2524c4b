"""Programs of the lab, and fuzzing."""

import logging
import os
import subprocess
import sys
from contextlib import suppress

import pytest
import torch

from lab.common import scenes
from lab.robustness import fuzz_judge
from lab.robustness.fuzz_readers import READERS
from lab.robustness.fuzzing import CORPUS
from making import LAB, REPOSITORY
from pointsplat_ns.errors import PointSplatError

PROGRAMS = sorted(
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__main__")
    for path in LAB.rglob("*.py")
    if 'if __name__ == "__main__":' in path.read_text("utf-8")
)

ASK_FOR_HELP = """
import os, runpy, sys
import lab.common.compare, lab.common.scenes  # take seconds, so once for all; then each runs in a process of its own
for program in sys.argv[1:]:
    if os.fork() == 0:
        sys.argv = [program, "--help"]
        runpy.run_module(program, run_name="__main__", alter_sys=True)
        sys.exit("it did not end after its help")
    assert os.wait()[1] == 0, program
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="saves imports by forking")
def test_every_program_starts():
    assert len(PROGRAMS) > 10
    command = [sys.executable, "-c", ASK_FOR_HELP, *PROGRAMS]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(PROGRAMS)


def test_the_readme_names_every_program():
    text = (LAB / "README.md").read_text("utf-8")
    assert not [name for name in PROGRAMS if f"python -m {name}" not in text]
    assert len(text.split()) <= 1000


def test_no_scene_is_both_tuned_on_and_judged():
    assert not {*scenes.TUNING} & {*scenes.JUDGED}
    assert [scenes.group_of(name) for name in ("fox", "lounge", "mine")] == ["tuning", "judged", ""]


def test_a_trained_scene_is_a_case_of_the_rasterizers_times(trained_walls):
    (run_folder,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    dense, tenth = scenes.trained_scenes(run_folder, 0)
    assert abs(len(tenth) - 0.1 * len(dense)) <= 0.5
    assert dense.focal == pytest.approx(60 / 64)  # as conftest.py's camera has it
    rotation = dense.viewmat[:3, :3]
    assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)  # float32


NAMES = sorted(path.name for path in CORPUS.iterdir())


@pytest.fixture(autouse=True)
def quiet():
    logger = logging.getLogger("pointsplat_ns")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(before)


@pytest.mark.parametrize("name", NAMES)
def test_what_fuzzing_kept_is_read_or_refused(name, tmp_path):
    read, files = READERS[name](tmp_path), sorted((CORPUS / name).iterdir())
    with suppress(PointSplatError):
        read(files[0].read_bytes())  # imports what it needs, whose memory is not the file's
    outcomes = {path.name: fuzz_judge.judge(read, path.read_bytes()) for path in files}
    assert "read" in outcomes.values(), "or nothing beyond the first check is tried"


def test_the_judge_stops_what_does_not_end(monkeypatch):
    def endless(_):
        while True:
            pass

    monkeypatch.setattr(fuzz_judge, "SECONDS", 0.1)  # of the processor
    with pytest.raises(fuzz_judge.Wrong, match="more than 0.1 s"):
        fuzz_judge.judge(endless, b"")
