"""Progress bars."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

Progress = Callable[[str, float], None]
"""Called with the name of the current task and the share of it that is done, in [0, 1]."""

T = TypeVar("T")


def silent(what: str, share: float) -> None:
    """Progress that is not shown."""


@contextmanager
def progress_bar(progress: bool | Progress = True) -> Iterator[Progress]:
    """A bar in the terminal or notebook, with an estimate of the time left; it is erased at the end.

    Args:
        progress: True shows a bar (on standard error, if that is a terminal), False shows none; a function is returned
            as it is.
    """
    if callable(progress):
        yield progress
        return
    if not progress:
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    shown = console.is_terminal or console.is_jupyter
    with Bar(*columns, console=console, transient=True, disable=not shown) as bar:
        tasks: dict[str, Any] = {}

        def show(what: str, share: float) -> None:
            if what not in tasks:
                for task in tasks.values():
                    bar.update(task, visible=False)
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=share, visible=True)

        yield show


def tracked(items: Iterable[T], what: str, total: int, progress: bool | Progress = True) -> Iterator[T]:
    """Iterate over the items, with a bar that shows how many of ``total`` are done."""
    with progress_bar(progress) as show:
        report = functools.partial(show, what)
        report(0.0)
        for done, item in enumerate(items):
            yield item
            report((done + 1) / max(total, 1))
