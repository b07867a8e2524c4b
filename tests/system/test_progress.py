"""Progress, and programs that are called."""

import io
import re
import sys
import time

import psutil
import pytest

from pointsplat_ns.system import progress
from pointsplat_ns.system.programs import ProgramFailed, run_measured
from pointsplat_ns.system.progress import progress_bar, tracked


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture()
def stderr(monkeypatch):
    """A function that puts a stream in place of standard error."""
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE", "JPY_PARENT_PID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")

    def put(stream):
        monkeypatch.setattr(sys, "stderr", stream)
        return stream

    return put


def read_until(stream: io.StringIO, text: str) -> str:
    """What was written, as soon as it holds ``text``; after a minute at the latest."""
    end = time.monotonic() + 60
    while text not in stream.getvalue() and time.monotonic() < end:
        time.sleep(0.01)
    assert text in stream.getvalue()
    return stream.getvalue()


def test_a_log_gets_a_plain_line_from_time_to_time(stderr, monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.05)
    log = stderr(io.StringIO())
    with progress_bar() as report:
        read_until(log, "[0:00] starting\n")
        report("First", 0.126)
        read_until(log, "First: 13 %\n")
        report("Second", 1.0)
        read_until(log, "Second: 100 %\n")
    lines = log.getvalue().splitlines()
    assert all(re.fullmatch(r"\[\d+:\d\d\] (starting|First: 13 %|Second: 100 %)", line) for line in lines)
    time.sleep(0.2)
    assert log.getvalue().splitlines() == lines  # it ends with the work


def test_a_function_hears_the_share_done_after_each_item():
    heard = []
    for _ in tracked(range(4), "Counting", 4, lambda what, share: heard.append((what, share))):
        pass
    assert heard == [("Counting", share) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]


def test_the_bar_is_taken_away_when_the_work_fails(stderr):
    shown = stderr(Terminal())
    with pytest.raises(ValueError), progress_bar() as report:
        report("Failing", 0.5)
        raise ValueError
    assert shown.getvalue().endswith("\x1b[2K")


PARENT, CHILD = 2**30, 200_000_000
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


def test_peak_memory_is_that_of_the_largest_process():
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', 'held = b\"x\" * {CHILD}'], check=True)"
    assert run_measured(python(code)).peak_bytes > CHILD


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


def test_a_program_that_takes_too_long_is_ended_with_what_it_started(tmp_path):
    started = tmp_path / "started"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {WAITS!r}, {str(started)!r}])"
    with pytest.raises(ProgramFailed, match="took more than 3 s and was ended"):
        run_measured(python(code), timeout=3)
    number = int(started.read_text())
    for _ in range(100):  # until the system has taken it away
        if not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE:
            return
        time.sleep(0.05)
    pytest.fail(f"process {number} is still there")


WAITS = "import os, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(600)"
