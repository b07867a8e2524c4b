"""Programs that are called, and measured."""

import sys

import psutil
import pytest

from lab.common.programs import ProgramFailed, run_measured

PARENT = 2**29
CHILD = 100_000_000
"""Bytes held by the process that measures, and by the one that is measured."""


def python(code: str) -> list[str]:
    return [sys.executable, "-I", "-S", "-c", code]


def test_peak_memory_is_the_childs_own_and_not_its_parents():
    held = b"x" * PARENT
    small = run_measured(python("pass")).peak_bytes
    large = run_measured(python(f"held = b'x' * {CHILD}")).peak_bytes
    assert len(held) == PARENT
    assert small < CHILD / 4  # an interpreter alone takes about 10 MB
    assert large - small == pytest.approx(CHILD, rel=0.02)  # pages, and what the allocator adds


@pytest.mark.parametrize(
    "command, said",
    [
        (
            python("import sys; sys.exit('no\\nsuch\\nscene')"),
            "ended with status 1: no such scene$",
        ),
        (python("import os; os.kill(os.getpid(), 9)"), "was killed by signal 9"),
        (["/no/such/program"], "/no/such/program.*FileNotFoundError|No such file"),
    ],
    ids=["fails", "is killed", "is not there"],
)
def test_a_program_that_fails_is_an_error_with_what_it_said_in_one_line(command, said):
    with pytest.raises(ProgramFailed, match=said):
        run_measured(command)


def test_a_program_that_takes_too_long_is_killed_with_all_that_it_started(tmp_path):
    def running() -> list[psutil.Process]:
        return [
            p
            for p in psutil.process_iter(["cmdline"])
            if str(tmp_path) in (p.info["cmdline"] or ())
        ]

    with pytest.raises(ProgramFailed, match="took more than 2 s and was ended"):
        run_measured([*python("import time; time.sleep(600)"), str(tmp_path)], timeout=2.0)
    psutil.wait_procs(running(), timeout=30)  # the system takes a moment
    assert not running()
