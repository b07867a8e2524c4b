"""benchmarks/refinement.py evaluate and report, on short trainings; and every benchmark starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from making import BENCHMARKS
from pointsplat_ns.compression.trained_refiner import load_refiner
from pointsplat_ns.refiner import save_refiner

PROGRAMS = (
    "compaction",
    "cuda",
    "docs_pictures",
    "drawing",
    "example_room",
    "formats",
    "frame_times",
    "fuzzing",
    "judge",
    "judge_record",
    "kills",
    "mutants",
    "opensplat",
    "photo_places",
    "quality",
    "rasterizer",
    "refinement",
    "refiner",
    "repair",
    "sampled_views",
    "second_order",
    "small_numbers",
    "soak",
    "stability",
    "threads",
    "training",
)


ASK_FOR_HELP = """
import os, runpy, sys
import torch, tyro  # takes seconds, so once for all; each program then runs in a process of its own
for program in sys.argv[1:]:
    if os.fork() == 0:
        sys.path[0], sys.argv = os.path.dirname(program), [program, "--help"]
        runpy.run_path(program, run_name="__main__")
        sys.exit("it did not end after its help")
    assert os.wait()[1] == 0, program
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="saves imports by forking")
def test_every_benchmark_starts():
    programs = [str(BENCHMARKS / f"{name}.py") for name in PROGRAMS]
    done = subprocess.run([sys.executable, "-c", ASK_FOR_HELP, *programs], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(PROGRAMS)


def test_the_programs_are_all_there_are():
    programs = {
        path.stem for path in BENCHMARKS.glob("*.py") if 'if __name__ == "__main__":' in path.read_text("utf-8")
    }
    assert programs == set(PROGRAMS)


@pytest.fixture(scope="module")
def refiners(make_refined_run, trained_walls, tmp_path_factory) -> Path:
    """A folder with a refiner as a training leaves it; it makes every Gaussian a little more opaque."""
    folder = tmp_path_factory.mktemp("refiners")
    run_folder = make_refined_run(folder, trained_walls, by="paper", moved=0.1)
    save_refiner(load_refiner(run_folder, "cpu").network, run_folder / "refiner.safetensors", {"scenes": "wall-b"})
    return folder


def test_refiners_are_judged_row_by_row_and_what_is_there_is_not_done_again(
    refiners, trained_walls, tmp_path, run_benchmark
):
    (scene,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    options = ("--keeps", "0.5", "--starts", "paper", "--views", "2", "--fine-tune", "2", "--photos", "--no-lpips")
    command = ("refinement", "evaluate", "--refiners", refiners, "--scenes", scene, "--json", tmp_path / "rows.json")
    said = run_benchmark(*command, *options, "--pictures", tmp_path / "pictures")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    variants = ["dense", "selected", "as shipped", "dual", "fine-tuned", "fine-tuned on photos"]
    assert sorted(row["variant"] for row in rows) == sorted(variants)
    assert all(row["scene"] == "wall-a" and row["photo_psnr"] > 5 for row in rows)
    by = {row["variant"]: row for row in rows}
    assert by["selected"]["count"] == by["dual"]["count"] < by["dense"]["count"]
    assert by["dual"]["photo_psnr"] != by["selected"]["photo_psnr"]
    assert by["dual"]["seen"] is False
    assert (tmp_path / "pictures" / "wall-a_50.png").read_bytes().startswith(b"\x89PNG")
    assert "1 refiners: " in said and "paper + dual, seed 0" in said
    again = run_benchmark(*command, *options, "--pictures", tmp_path / "pictures")
    assert json.loads((tmp_path / "rows.json").read_text())["rows"] == rows
    assert "dB against photos" in said and "dB against photos" not in again
    assert "dual beats selected" in run_benchmark("refinement", "report", tmp_path / "rows.json")


def test_a_trained_scene_is_a_case_of_the_rasterizers_benchmark(trained_walls, monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    from scenes import trained_scenes

    (run_folder,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    dense, tenth = trained_scenes(run_folder, None, 0)
    assert len(tenth) == round(0.1 * len(dense)) or abs(len(tenth) - 0.1 * len(dense)) <= 0.5
    assert dense.focal == pytest.approx(60 / 64)  # as conftest.py's camera has it
    rotation = dense.viewmat[:3, :3]
    assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)  # float32
