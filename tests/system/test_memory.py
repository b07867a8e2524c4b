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
    torch.ones(10_000_000) + 1  # two blocks of 40 MB, more than glibc ever keeps by itself
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
# The first rounds break up the memory that there is; later ones find their places.
print(kept, min(faults() for _ in range(6)))
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
    # 80 MB are 19,500 pages of 4 kB; larger pages make fewer.
    assert after < 0.1 * before


THREADS = """
import ctypes, sys, threading
from pointsplat_ns.system.memory import share_freed_memory
shared = sys.argv[1] == "keep" and share_freed_memory()
libc, all_there = ctypes.CDLL("libc.so.6"), threading.Barrier(6)
libc.malloc.restype = ctypes.c_void_p
def work():
    libc.malloc(60_000)
    all_there.wait()
threads = [threading.Thread(target=work) for _ in range(6)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc.malloc_stats()  # one line "Arena N:" on standard error for each place to allocate from
print(shared)
"""


def test_threads_share_the_places_that_they_allocate_from():
    def places(word: str) -> tuple[bool, int]:
        done = subprocess.run([sys.executable, "-c", THREADS, word], capture_output=True, text=True, check=True)
        return done.stdout.strip() == "True", done.stderr.count("Arena ")

    shared, few = places("keep")
    if not shared:
        pytest.skip("not Linux with glibc, where there is nothing to do")
    assert few <= 2 < places("leave")[1]
