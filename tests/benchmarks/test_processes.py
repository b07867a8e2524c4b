"""Time and memory of other programs, as benchmarks/processes.py measures them."""

from __future__ import annotations

import sys

import pytest

PARENT, CHILD = 2**30, 200_000_000
"""Bytes held by the process that measures, and by the one that is measured."""


@pytest.fixture(scope="module")
def processes(benchmark):
    return benchmark("processes")


def python(code: str) -> list[str]:
    return [sys.executable, "-I", "-S", "-c", code]


def test_peak_memory_is_the_childs_own_and_not_its_parents(processes):
    held = b"x" * PARENT
    small = processes.run_measured(python("pass")).peak_bytes
    large = processes.run_measured(python(f"held = b'x' * {CHILD}")).peak_bytes
    assert len(held) == PARENT
    assert small < CHILD / 4  # an interpreter alone takes about 10 MB
    assert large - small == pytest.approx(CHILD, rel=0.02)  # pages, and what the allocator adds


def test_peak_memory_is_that_of_the_largest_process(processes):
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', 'held = b\"x\" * {CHILD}'], check=True)"
    assert processes.run_measured(python(code)).peak_bytes > CHILD


BUSY = "import time\nwhile time.process_time() < 0.3: pass"


def test_cpu_seconds_count_threads_and_processes_that_were_waited_for(processes):
    code = f"import subprocess, sys; [subprocess.run([sys.executable, '-c', {BUSY!r}]) for _ in range(2)]"
    assert processes.run_measured(python(BUSY)).cpu_seconds >= 0.29  # the clocks differ by a tick of 4 ms or so
    assert processes.run_measured(python(code)).cpu_seconds >= 0.58


@pytest.mark.parametrize(
    "code, said",
    [
        ("import sys; sys.exit('no such scene')", "ended with status 1: no such scene"),
        ("import os; os.kill(os.getpid(), 9)", "was killed by signal 9"),
    ],
)
def test_a_program_that_fails_is_an_error_with_what_it_said(processes, code, said):
    with pytest.raises(processes.ProgramFailed, match=said):
        processes.run_measured(python(code))


def test_a_program_that_is_not_there_is_an_error_that_names_it(processes):
    with pytest.raises(processes.ProgramFailed, match="/no/such/program.*FileNotFoundError|No such file"):
        processes.run_measured(["/no/such/program"])


def test_a_program_that_writes_nothing_is_an_error(processes, tmp_path):
    reducer = processes.Reducer("idle", lambda source, count, target: python("pass"))
    with pytest.raises(processes.ProgramFailed, match="wrote no file"):
        reducer.reduce(tmp_path / "room.ply", 10)
