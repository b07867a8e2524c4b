"""Progress bars, and lines in place of them."""

import io
import re
import sys
import time

import pytest

from pointsplat_ns.system import progress
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
