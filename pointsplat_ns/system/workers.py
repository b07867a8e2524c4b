"""Distributes work over several processes of this machine, with :mod:`concurrent.futures`, or over
a cluster."""

from __future__ import annotations

import functools
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.system.cores import cores
from pointsplat_ns.system.threads import THREADS_VARIABLE, fixed_threads, most_threads

if TYPE_CHECKING:
    from pointsplat_ns.system.cluster import Cluster

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers(Generic[Item, Result]):
    """Processes that call a function for items and share the cores. With one job, the current
    process does the work. When the context or this process ends, the others end at once.

    Args:
        function: pickled once per process, or once per item for a cluster.
        jobs: number of processes; 1 for a cluster.
        cluster: does the work, if given.
        shared: absolute path of a file that a cluster must see.
    """

    def __init__(
        self,
        function: Callable[[Item], Result],
        jobs: int,
        cluster: Cluster | None = None,
        shared: Path = Path(os.sep),
    ):
        self._function = function
        self._jobs = jobs
        self._cluster = cluster
        self._shared = shared

    def __enter__(self) -> Workers[Item, Result]:
        if self._jobs > 1:
            context = get_context("spawn")
            ends, self._held = context.Pipe(duplex=False)
            # multiprocessing would move tensors to shared memory
            function = pickle.dumps(self._function)
            # a pool starts multiprocessing's resource tracker
            with _started_safely(self._jobs):
                self._pool = ProcessPoolExecutor(self._jobs, context, _begin, (ends, function))
        return self

    def __exit__(self, *_: object) -> None:
        if self._jobs > 1:
            self._held.close()  # all processes notice this
            self._pool.shutdown(cancel_futures=True)

    def results(self, items: Iterable[Item]) -> Iterator[tuple[Item, Result]]:
        """Each item with its result, in order of completion. Raises the exceptions of the function,
        and PointSplatError if a process is killed; on a cluster as
        :meth:`~pointsplat_ns.system.cluster.Cluster.results`."""
        if self._cluster is not None:
            yield from self._cluster.results(self._function, items, self._shared)
            return
        if self._jobs == 1:
            for item in items:
                yield item, self._function(item)
            return
        try:
            with _started_safely(self._jobs):
                futures = {self._pool.submit(_call, item): item for item in items}
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise PointSplatError(
                "a process was killed, probably because memory ran out; run the same command to "
                "resume, with fewer --jobs if needed"
            ) from error


def check_jobs(jobs: int, cluster: str | None = None) -> None:
    """Raise a DataError if the number of processes is not positive, or above 1 for a cluster."""
    if jobs < 1:
        raise DataError(f"jobs is {jobs}; expected 1 or more")
    if jobs > 1 and cluster is not None:
        raise DataError(
            f"jobs is {jobs}; expected none with a cluster, which has as many processes as its "
            "workers"
        )


_function: Callable[[], Callable[[Any], Any]]
"""The function, in a process of :class:`Workers`."""


def _begin(ends: connection.Connection, function: bytes) -> None:
    """Initialise a process: it ends with its parent, and leaves Ctrl-C to the parent."""
    global _function
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(ends,), daemon=True).start()
    _function = functools.cache(functools.partial(pickle.loads, function))


def _call(item: Any) -> Any:
    return _function()(item)


def _end_with(ends: connection.Connection) -> None:
    """End this process at once when the other end of a pipe is closed."""
    connection.wait([ends])
    os._exit(1)


_starting = threading.Lock()

SAFE_PATH_VARIABLE = "PYTHONSAFEPATH"
"""Environment variable that keeps the current folder off the path, from Python 3.11 on."""

HAS_SAFE_PATH = sys.version_info >= (3, 11)


@contextmanager
def _started_safely(jobs: int) -> Iterator[None]:
    """Inside of this context, child processes ignore Ctrl-C, do not have the current folder on
    their path, and use as many threads as the environment variable ``OMP_NUM_THREADS`` says, or
    else their share of the cores.

    multiprocessing starts them and its resource tracker with ``python -c``, which puts the current
    folder first on the path: files beside the scenes would be imported in place of Python's own
    modules. Ctrl-C would print a traceback of each process that is still importing, so processes
    inherit a blocked signal.

    Raises:
        PointSplatError: with Python 3.10, which has no option against it, if the current folder has
            a file or folder with the name of one of Python's own modules.
    """
    if not HAS_SAFE_PATH:
        _need_no_shadows(Path.cwd())
    threads = most_threads() if THREADS_VARIABLE in os.environ else max(1, cores() // jobs)
    with _starting, fixed_threads(threads), _environment(SAFE_PATH_VARIABLE, "1"):
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    """Set an environment variable inside of the context."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def _need_no_shadows(folder: Path) -> None:
    """Raise PointSplatError if a file or folder has the name of one of Python's own modules."""
    for path in sorted(folder.iterdir()):
        if path.name.split(".")[0] in sys.stdlib_module_names:
            raise PointSplatError(
                f"{path}: Python 3.10 would import it in place of its own module in processes that "
                "are started here; expected no such name; start the command in another folder, or "
                "with Python 3.11"
            )
