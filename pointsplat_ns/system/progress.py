"""Progress bars, or log lines if there is no terminal."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, TypeVar

from pointsplat_ns.errors import printable

Progress = Callable[[str, float], None]
"""Called with the name of the current task and its share done, in [0, 1]."""

Item = TypeVar("Item")


def silent(what: str, share: float) -> None:
    """Progress that is not displayed."""


def within(whole: str, progress: Progress) -> Progress:
    """Progress of subtasks: their names follow the name of the whole task."""
    return lambda what, share: progress(f"{whole}: {what}", share)


@contextmanager
def progress_bar(progress: bool | Progress = True) -> Iterator[Progress]:
    """A progress bar in the terminal or notebook, with an estimate of the time left; it is erased
    at the end. Elsewhere, as in a log file, a line at intervals, such as ``[1:30] merging: 45 %,
    about 1:50 left``: minutes and seconds since the start, and the estimated time left for the
    current task.

    True shows a bar or writes lines, on standard error; False shows nothing; a function is returned
    unchanged.
    """
    if callable(progress):
        yield progress
        return
    if not progress:
        yield silent
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    if not console.is_jupyter and (console.is_dumb_terminal or not console.is_terminal):
        yield _lines(console.file)
        return
    with Bar(*columns, console=console, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def show(what: str, share: float) -> None:
            if what not in tasks:
                for task in tasks.values():
                    bar.update(task, visible=False)
                tasks[what] = bar.add_task(escape(printable(what)), total=1.0)
            bar.update(tasks[what], completed=share, visible=True)

        yield show


def _lines(stream: IO[str]) -> Progress:
    """Writes the current task to ``stream``, every 30 seconds."""
    start = written = time.monotonic()
    begun: dict[
        str, tuple[float, float]
    ] = {}  # start time of each task, and its share done by then

    def show(what: str, share: float) -> None:
        nonlocal written
        now = time.monotonic()
        start_of_task, before = begun.setdefault(what, (now, share))
        if now - written < 30.0:
            return
        written = now
        gained = share - before
        left = ""
        if gained > 0 and share < 1:
            left = f", about {_clock((now - start_of_task) * (1 - share) / gained)} left"
        with suppress(OSError, ValueError):  # the stream is closed: the work continues
            print(
                f"[{_clock(now - start)}] {printable(what)}: {100 * share:.0f} %{left}",
                file=stream,
                flush=True,
            )

    return show


def _clock(seconds: float) -> str:
    """Minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def tracked(
    items: Iterable[Item], what: str, total: int, progress: bool | Progress = True
) -> Iterator[Item]:
    """Iterate over the items, with a progress bar of ``total`` items."""
    with progress_bar(progress) as show:
        report = functools.partial(show, what)
        report(0.0)
        for done, item in enumerate(items):
            yield item
            report((done + 1) / max(total, 1))
