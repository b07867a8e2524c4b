"""Freed memory serves again: seen by the pages that the system has to clear."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
import torch
from pointsplat_ns.system.memory import keep_freed_memory
kept = sys.argv[1] == "keep" and keep_freed_memory()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(16_000_000) + 1  # two blocks of 64 MB
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
# The first rounds break up the memory that there is; later ones find their places.
print(kept, min(faults() for _ in range(8)))
"""


def run(word: str) -> tuple[bool, int]:
    out = subprocess.run([sys.executable, "-c", PROGRAM, word], capture_output=True, text=True, check=True).stdout
    kept, faults = out.split()
    return kept == "True", int(faults)


def test_large_tensors_cost_new_pages_once():
    kept, after = run("keep")
    if not kept:
        pytest.skip("not Linux with glibc, where there is nothing to do")
    before = run("leave")[1]
    # 128 MB are 31,250 pages of 4 kB; larger pages make fewer.
    assert after < 0.1 * before
