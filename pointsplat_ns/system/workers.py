"""Work in several processes that may be killed at any time."""

from __future__ import annotations

import heapq
import itertools
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection, util
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar

import torch

from pointsplat_ns.system.cores import cores

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class RetrySettings:
    """When items are tried again."""

    later_seconds: float = 1.0
    """Time until an item is tried again whose result was None."""
    most_deaths: int = 10
    """Number of processes that may be killed at one item, as by a lack of memory, before it is given up. Where they are
    killed at random, so many are hardly ever killed at the same one."""


RETRIES = RetrySettings()


def threads_for(jobs: int) -> int:
    """Number of threads that each of several processes may use: what the environment variable ``OMP_NUM_THREADS`` says,
    else its share of the cores."""
    if "OMP_NUM_THREADS" in os.environ:
        return torch.get_num_threads()
    return max(1, cores() // jobs)


def in_turn(function: Callable[[Item], Result | None], items: Sequence[Item]) -> Generator[Result, None, None]:
    """The results of a function for each item, made in this process. An item whose result is None is tried again later,
    until it has one."""
    waiting = _Waiting(items)
    while waiting:
        if (number := waiting.pop()) is None:
            time.sleep(waiting.seconds())
        elif (result := function(items[number])) is None:
            waiting.put_off(number)
        else:
            yield result


def in_processes(
    function: Callable[[Item], Result | None],
    items: Sequence[Item],
    jobs: int,
    on_death: Callable[[Item, str], Result],
    on_stop: Callable[[Item], object],
    preload: Sequence[str],
) -> Generator[Result, None, None]:
    """The results of a function for each item, in the order in which they are made, in several processes.

    An item whose result is None is tried again later, until it has one. An item whose process is killed is tried again
    by another. When the iteration is ended early, for one by Ctrl-C, all processes are killed.

    Args:
        function: called with an item. It, the items and results are pickled.
        items: the items.
        jobs: number of processes.
        on_death: called in this process with an item at which ``RETRIES.most_deaths`` processes were killed, and with
            how the last one ended; gives the item's result.
        on_stop: called in this process with every item at which a process was killed because the iteration was ended.
        preload: modules that take long to import; where processes can be forked, they are imported but once.

    Raises:
        RuntimeError: if processes end before they can be given anything.
    """
    waiting, deaths, idle_deaths = _Waiting(items), Counter[int](), 0
    workers: list[_Worker[Item, Result]] = []
    threads = threads_for(jobs)
    try:
        while waiting or any(worker.at is not None for worker in workers):
            while len(workers) < jobs and len(workers) < len(waiting) + sum(w.at is not None for w in workers):
                workers.append(_Worker.start(function, threads, preload))
            idle = [worker for worker in workers if worker.ready and worker.at is None]
            for worker in idle:
                if (number := waiting.pop()) is not None:
                    worker.give(number, items[number])
            some_idle = any(worker.at is None for worker in idle)
            connection.wait([w.pipe for w in workers], waiting.seconds() if some_idle and waiting else None)
            for worker in [worker for worker in workers if worker.pipe.poll()]:
                number = worker.at
                try:
                    result = worker.take()
                except (EOFError, OSError):  # it was killed
                    workers.remove(worker)
                    how = worker.end()
                    idle_deaths = idle_deaths + 1 if number is None else 0
                    if idle_deaths == 20:  # ended one after the other, before they were given an item
                        raise RuntimeError(f"{idle_deaths} processes in a row ended at once; the last {how}") from None
                    if number is not None:
                        deaths[number] += 1
                        if deaths[number] < RETRIES.most_deaths:
                            waiting.put_off(number)
                        else:
                            yield on_death(items[number], how)
                    continue
                if number is not None and result is not None:
                    yield result
                elif number is not None:
                    waiting.put_off(number)
    finally:
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.end()
            if worker.at is not None:
                on_stop(items[worker.at])


class _Waiting:
    """Numbers of items that wait to be tried, now or later."""

    def __init__(self, items: Sequence[object]):
        self._order = itertools.count()
        self._heap = [(0.0, next(self._order), number) for number in range(len(items))]

    def __len__(self) -> int:
        return len(self._heap)

    def pop(self) -> int | None:
        """The next number; None if there is none whose time has come."""
        return heapq.heappop(self._heap)[2] if self._heap and self.seconds() == 0 else None

    def put_off(self, number: int) -> None:
        """Let a number wait for some time, and for those that wait already."""
        heapq.heappush(self._heap, (time.monotonic() + RETRIES.later_seconds, next(self._order), number))

    def seconds(self) -> float:
        """Time until the next number's time has come."""
        return max(0.0, self._heap[0][0] - time.monotonic())


@dataclass(eq=False)
class _Worker(Generic[Item, Result]):
    """A process that applies a function to one item after the other."""

    process: BaseProcess
    pipe: connection.Connection
    ready: bool = False
    """Whether it has imported all that it needs."""
    at: int | None = None
    """Number of the item that it works on."""

    @classmethod
    def start(
        cls, function: Callable[[Item], Result | None], threads: int, preload: Sequence[str]
    ) -> _Worker[Item, Result]:
        """Start a process."""
        # A server that has imported everything is forked, which takes no time and shares memory. This process is not,
        # as threads of its own may hold locks.
        forks = "forkserver" in multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(function, threads, there), daemon=True)
        # The environment is for the server, of which processes inherit it.
        with _environment(OMP_NUM_THREADS=str(threads)), _started_safely():
            if forks:
                context.set_forkserver_preload([*preload])
            process.start()
        there.close()
        return cls(process, here)

    def give(self, number: int, item: Item) -> None:
        """Let it work on an item. A process that has ended takes none, which :meth:`take` then finds."""
        self.at = number
        try:
            self.pipe.send(item)
        except OSError:
            pass

    def take(self) -> Result | None:
        """What it has made of its item; None if it says only that it is ready. Raises EOFError or OSError if it has
        ended."""
        result = self.pipe.recv()
        self.ready, self.at = True, None
        return result

    def end(self) -> str:
        """Wait for the process, which has ended or is about to, and say how it ended."""
        self.process.join()
        self.pipe.close()
        status = self.process.exitcode or 0
        return f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"


def _serve(function: Callable[[Item], Result | None], threads: int, pipe: connection.Connection) -> None:
    """The body of a process. Ctrl-C is for the process that started it, which kills it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    torch.set_num_threads(threads)
    pipe.send(None)
    while True:
        try:
            item = pipe.recv()
        except EOFError:
            return
        pipe.send(function(item))


def _end_with(sentinel: int) -> None:
    """End this process, whatever it does, when the one that started it ends."""
    connection.wait([sentinel])
    os._exit(1)


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Set environment variables while the context is open."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_STARTING = threading.Lock()


@contextmanager
def _started_safely() -> Iterator[None]:
    """Keep the current folder off the path of Python's helpers while the context is open.

    multiprocessing starts its server and its resource tracker with ``python -c``, which puts the current folder first
    on the path: what lies beside the scenes would be imported in place of Python's own modules. Python 3.10 has no
    option against it.
    """

    def start_safely(path: bytes, args: Sequence[str], passfds: Sequence[int]) -> int:
        words = [*args]
        at = words.index("-c") + 1
        words[at] = f"import sys; sys.path = [*filter(None, sys.path)]; {words[at]}"  # sys is part of the interpreter
        return start(path, words, passfds)

    with _STARTING:
        helpers: Any = util
        start = helpers.spawnv_passfds
        helpers.spawnv_passfds = start_safely
        try:
            yield
        finally:
            helpers.spawnv_passfds = start
