"""Work that several processes of this machine share.

Processes are those of :mod:`concurrent.futures`, one in each pool: a pool that breaks then names the item at which its
process was killed, and the other processes go on.
"""

from __future__ import annotations

import functools
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, get_context, util
from typing import Any, Generic, TypeVar

import torch

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.system.cores import cores
from pointsplat_ns.system.threads import THREADS_VARIABLE, fixed_threads

Item = TypeVar("Item")
Result = TypeVar("Result")


class WorkerKilled(PointSplatError):
    """The process that worked on an item was killed twice, as the system does where memory is short."""


class Workers(Generic[Item, Result]):
    """Processes that call a function with one item after the other, and share the cores. With one job, this process
    does. When the context is left, or this process ends, the others end at once, whatever they do.

    Args:
        function: pickled once for each process.
        jobs: number of processes.
    """

    def __init__(self, function: Callable[[Item], Result], jobs: int):
        self._function, self._jobs = function, jobs
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Result], tuple[ProcessPoolExecutor, Item]] = {}
        self._context = get_context("spawn")
        self._ends, self._held = self._context.Pipe(duplex=False)

    def __enter__(self) -> Workers[Item, Result]:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()  # which all processes notice
        for pool in [*self._idle, *(pool for pool, _ in self._busy.values())]:
            pool.shutdown()
        self._ends.close()

    def results(self, items: Iterable[Item]) -> Iterator[tuple[Item, Result | WorkerKilled]]:
        """Each item with its result, in the order in which they are made. An item whose process is killed is tried
        once more; if that one is killed too, its result is the error. Raises what the function raises."""
        if self._jobs == 1:
            for item in items:
                yield item, self._function(item)
            return
        waiting, again = deque(items), list[Item]()
        while waiting or self._busy:
            with _started_safely(threads_for(self._jobs)):
                while waiting and len(self._busy) < self._jobs:
                    self._give(waiting.popleft())
            for future in wait(self._busy, return_when=FIRST_COMPLETED).done:
                pool, item = self._busy.pop(future)
                if not isinstance(future.exception(), BrokenProcessPool):
                    self._idle.append(pool)
                    yield item, future.result()
                elif item in again:
                    yield item, WorkerKilled("its process was killed twice, as happens where memory is short")
                else:
                    again.append(item)
                    waiting.append(item)

    @functools.cached_property
    def _pickled(self) -> bytes:
        return pickle.dumps(self._function)  # by multiprocessing, tensors would be moved to shared memory

    def _give(self, item: Item) -> None:
        """Let an idle process, or a new one, work on an item."""
        if self._idle:
            pool = self._idle.pop()
        else:
            pool = ProcessPoolExecutor(1, self._context, _begin, (self._ends, self._pickled))
        try:
            self._busy[pool.submit(_call, item)] = pool, item
        except BrokenProcessPool:  # it was killed while it had nothing to do
            self._give(item)


def check_jobs(jobs: int) -> None:
    """Raise a DataError if a number of processes is not positive."""
    if jobs < 1:
        raise DataError(f"jobs is {jobs}; expected 1 or more")


def threads_for(jobs: int) -> int:
    """Number of threads that each of several processes may use: what the environment variable ``OMP_NUM_THREADS`` says,
    else its share of the cores."""
    return torch.get_num_threads() if THREADS_VARIABLE in os.environ else max(1, cores() // jobs)


_function: Callable[[], Callable[[Any], Any]]
"""In a process of :class:`Workers`: gives its function."""


def _begin(ends: connection.Connection, function: bytes) -> None:
    """The start of a process, which ends with the one that started it. Ctrl-C is for that one."""
    global _function
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(ends,), daemon=True).start()
    _function = functools.cache(functools.partial(pickle.loads, function))


def _call(item: Any) -> Any:
    return _function()(item)


def _end_with(ends: connection.Connection) -> None:
    """End this process, whatever it does, when the other end of a pipe is closed."""
    connection.wait([ends])
    os._exit(1)


_STARTING = threading.Lock()


@contextmanager
def _started_safely(threads: int) -> Iterator[None]:
    """Let processes that are started while the context is open have so many threads, no Ctrl-C, and not the current
    folder on their path.

    multiprocessing starts them and its resource tracker with ``python -c``, which puts the current folder first on the
    path: what lies beside the scenes would be imported in place of Python's own modules. Python 3.10 has no option
    against it. Ctrl-C would show a traceback of each process that is still importing.
    """

    def start_safely(path: bytes, args: Sequence[str], passfds: Sequence[int]) -> int:
        words = [*args]
        at = words.index("-c") + 1
        words[at] = f"import sys; sys.path = [*filter(None, sys.path)]; {words[at]}"  # sys is part of the interpreter
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            return start(path, words, passfds)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    with _STARTING, fixed_threads(threads):
        helpers: Any = util
        start = helpers.spawnv_passfds
        helpers.spawnv_passfds = start_safely
        try:
            yield
        finally:
            helpers.spawnv_passfds = start
