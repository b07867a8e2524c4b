"""Every program of the lab starts and stands in its README; what programs share."""

import os
import subprocess
import sys

import pytest
import torch

from lab.common import scenes
from lab.common.results import Results
from lab.common.timing import slope
from making import LAB, REPOSITORY

PROGRAMS = sorted(
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
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
    assert len(text.split()) <= 900


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


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"rows": []}'])
def test_a_file_that_holds_no_rows_is_not_taken_up(tmp_path, text):
    path = tmp_path / "rows.json"
    path.write_text(text)
    with pytest.raises(SystemExit, match="cannot be taken up"):
        Results(path, {}, resume=True)
    with pytest.raises(SystemExit, match="--resume without --json"):
        Results(None, {}, resume=True)
    assert path.read_text() == text


def test_the_slope_is_the_exponent_of_what_is_positive():
    counts = [100_000, 300_000, 1_000_000, 10_000_000]
    assert slope(counts, [1e-5 * n**1.25 for n in counts]) == pytest.approx(1.25, abs=1e-9)
    assert slope(counts, [1e290 * n for n in counts]) == pytest.approx(1.0, abs=1e-9)
    assert slope(counts, [0.0, -1.0, 2.0, 20.0]) == pytest.approx(1.0)
    assert slope(counts, [None, None, 2.0, 20.0]) == pytest.approx(1.0)
    assert slope(counts[:1], [1.0]) is None and slope([5, 6], [1.0, 2.0]) is None and slope([], []) is None
