"""The progress bar: on a terminal only, gone when the work is done, or handed to a function."""

import io
import sys

import pytest

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


def test_a_terminal_shows_what_is_done_and_takes_it_away_at_the_end(stderr):
    shown = stderr(Terminal())
    assert list(tracked("abc", "Counting letters", 3)) == ["a", "b", "c"]
    assert "Counting letters" in shown.getvalue()
    assert shown.getvalue().endswith("\x1b[2K")  # erases its line


def test_nothing_is_written_where_there_is_no_terminal(stderr):
    shown = stderr(io.StringIO())
    assert list(tracked("abc", "Counting letters", 3)) == ["a", "b", "c"]
    assert shown.getvalue() == ""


def test_nothing_is_written_where_no_progress_is_wanted(stderr):
    shown = stderr(Terminal())
    assert list(tracked("abc", "Counting letters", 3, progress=False)) == ["a", "b", "c"]
    assert shown.getvalue() == ""


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


def test_several_steps_share_one_bar(stderr):
    shown = stderr(Terminal())
    with progress_bar() as report:
        report("First", 1.0)
        report("Second", 0.5)
        before = len(shown.getvalue())
    last = shown.getvalue()[before:]
    assert "Second" in last and "First" not in last
