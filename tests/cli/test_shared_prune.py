"""Processes that share the parts of a scene larger than memory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from refusing import refusal

from killing import KILLED_AFTER_STEPS
from making import normal_scene, quick_start
from pointsplat_ns.io import write_ply

PROGRAM = """
from pointsplat_ns.cli import main
from pointsplat_ns.compression import prune_file
prune_file.MEMORY = prune_file.MemorySettings(base=0, least=100)
killed_after_steps(int(sys.argv[1]))
main(["prune", "scene.ply", "--keep", "10%", *sys.argv[2:]])
"""


def pruned(folder: Path, *words: object, killed_at: int = 0) -> tuple[int, str]:
    """Exit status and text of a command, killed after some of its first process's steps unless that is 0."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED_AFTER_STEPS + PROGRAM, f"{killed_at}", *map(str, words)], cwd=folder,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, env=quick_start(),
    )  # fmt: skip
    return done.returncode, done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills processes")
def test_processes_that_share_a_scene_write_the_bytes_of_one_also_after_a_kill(tmp_path):
    write_ply(normal_scene(600, degree=1, seed=3), tmp_path / "scene.ply")
    parts = ("--memory", "50kB", "-o")
    status, said = pruned(tmp_path, *parts, "alone.ply")
    assert status == 0, said
    status, said = pruned(tmp_path, *parts, "shared.ply", "--jobs", 2, killed_at=5)
    assert status != 0 and not (tmp_path / "shared.ply").exists(), said
    assert len(list((tmp_path / ".shared.ply.cells").glob("round*"))) >= 2
    status, said = pruned(tmp_path, *parts, "shared.ply", "--jobs", 2)
    assert status == 0 and said.count("merged to 60 of 600 Gaussians") == 1, said
    assert (tmp_path / "shared.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_several_jobs_for_a_scene_that_fits_into_memory_are_refused(tmp_path, capsys):
    write_ply(normal_scene(50), tmp_path / "scene.ply")
    words = ("prune", tmp_path / "scene.ply", "--keep", "10%", "--jobs")
    fits = "scene.ply: fits into memory; --jobs is for a scene that is merged in parts"
    assert fits in refusal(capsys, tmp_path, *words, 2)
    assert "jobs is 0; expected 1 or more" in refusal(capsys, tmp_path, *words, 0, "--memory", "10kB")
