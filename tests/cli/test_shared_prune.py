"""Processes of torchrun that share the parts of a scene larger than memory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from killing import KILLED_AFTER_STEPS
from making import normal_scene, quick_start
from pointsplat_ns.io import write_ply

PROGRAM = """
from pointsplat_ns.cli import main
from pointsplat_ns.compression import prune_file
prune_file.MEMORY = prune_file.MemorySettings(base=0, least=100)
folder, output, memory = sys.argv[1], sys.argv[2], sys.argv[4]
killed_after_steps(int(sys.argv[3]))
main(["prune", f"{folder}/scene.ply", "--keep", "10%", "--memory", memory, "-o", f"{folder}/{output}"])
"""


def pruned(folder: Path, output: str, processes: int, killed_at: int = 0, memory: str = "100kB") -> tuple[int, str]:
    """Exit status and text of a command in so many processes, each killed after some steps unless that is 0."""
    program = folder / "prune.py"
    program.write_text(KILLED_AFTER_STEPS + PROGRAM)
    start = ("-m", "torch.distributed.run", "--nproc-per-node", f"{processes}") if processes > 1 else ()
    done = subprocess.run(
        [sys.executable, *start, str(program), str(folder), output, f"{killed_at}", memory],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300, env=quick_start(),
    )  # fmt: skip
    return done.returncode, done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills processes")
def test_processes_that_share_a_scene_write_the_bytes_of_one_also_after_a_kill(tmp_path):
    write_ply(normal_scene(1500, degree=1, seed=3), tmp_path / "scene.ply")
    status, said = pruned(tmp_path, "alone.ply", 1)
    assert status == 0, said
    status, said = pruned(tmp_path, "shared.ply", 2, killed_at=9)
    assert status != 0 and not (tmp_path / "shared.ply").exists(), said
    steps = {path.name: path.stat().st_mtime_ns for path in (tmp_path / ".shared.ply.cells").glob("round*")}
    assert len(steps) >= 2
    status, said = pruned(tmp_path, "shared.ply", 2)
    assert status == 0 and said.count("merged to 150 of 1,500 Gaussians") == 1, said
    assert (tmp_path / "shared.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_if_one_process_fails_all_end_and_say_why(tmp_path):
    write_ply(normal_scene(1500, degree=1, seed=3), tmp_path / "scene.ply")
    (tmp_path / "shared.ply").touch()
    status, said = pruned(tmp_path, "shared.ply", 2)  # the first process alone claims the output
    assert status != 0 and said.count("exists") == 2, said
    assert "error: process 0 of 2 failed: " in said
    status, said = pruned(tmp_path, "whole.ply", 2, memory="8GB")
    assert status != 0 and said.count("2 processes share the parts of a scene larger than --memory") == 2, said
