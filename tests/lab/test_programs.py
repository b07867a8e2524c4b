"""Programs that are called, and measured."""

import sys

import pytest

from lab.common.programs import ProgramFailed, run_measured

PARENT, CHILD = 2**29, 100_000_000
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
        (python("import sys; sys.exit('no\\nsuch\\nscene')"), "ended with status 1: no such scene$"),
        (python("import os; os.kill(os.getpid(), 9)"), "was killed by signal 9"),
        (["/no/such/program"], "/no/such/program.*FileNotFoundError|No such file"),
    ],
    ids=["fails", "is killed", "is not there"],
)
def test_a_program_that_fails_is_an_error_with_what_it_said_in_one_line(command, said):
    with pytest.raises(ProgramFailed, match=said):
        run_measured(command)
