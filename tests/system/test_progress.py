"""Progress bars, and lines in place of them."""

import io
import sys

import pytest

from pointsplat_ns.system import progress
from pointsplat_ns.system.progress import progress_bar, tracked


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture()
def stderr(monkeypatch):
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE", "JPY_PARENT_PID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")

    def put(stream):
        monkeypatch.setattr(sys, "stderr", stream)
        return stream

    return put


def test_a_log_gets_a_plain_line_from_time_to_time(stderr, monkeypatch):
    log = stderr(io.StringIO())
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    with progress_bar() as report:
        for clock[0], what, share in (
            (1, "First", 0.0),
            (31, "First", 0.25),
            (40, "First", 1.0),
            (62, "Second", 1.0),
        ):
            report(what, share)
    assert log.getvalue().splitlines() == [
        "[0:31] First: 25 %, about 1:30 left",
        "[1:02] Second: 100 %",
    ]


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
