"""Distributes work over the workers of a dask cluster, on any number of machines.

The scheduler of the cluster holds the queue, and gives the work of a worker that dies to others
(`dask.distributed <https://distributed.dask.org>`_). dask is imported only for an address.
"""

from __future__ import annotations

import asyncio
import json
import logging
import pickle
import socket
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch

import pointsplat_ns
from pointsplat_ns.errors import DataError, PointSplatError, need
from pointsplat_ns.system.files import logger, one_line, read_text

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_SECONDS = 10.0
"""Time in which a scheduler has to answer."""


class LostWorkError(PointSplatError):
    """Work whose workers died, one after another.

    Args:
        reasons: why, in one line, by item.
    """

    def __init__(self, reasons: dict[Any, str]):
        super().__init__("; ".join(f"{item}: {reason}" for item, reason in reasons.items()))
        self.reasons = reasons


@contextmanager
def connected(address: str | None) -> Iterator[Cluster | None]:
    """The cluster at an address inside of the context; None without an address.

    Args:
        address: of a scheduler, such as ``tcp://host:8786``, or the path of its scheduler file.
            Certificates for ``tls://`` are those of dask's configuration.

    Raises:
        MissingPackageError: without dask.distributed.
        DataError: if no scheduler answers there within :data:`CONNECT_SECONDS`.
    """
    if address is None:
        yield None
        return
    need("distributed", "--cluster")
    from distributed import Client

    with _quiet():
        try:
            place = _scheduler(address)
            _probe(place)
            client = Client(place, timeout=CONNECT_SECONDS, set_as_default=False)
        except DataError:
            raise
        except Exception as error:  # also what dask makes of the answers of other programs
            why = f" ({one_line(error)})" if str(error) else ""
            raise DataError(
                f"{address}: no dask scheduler answers within {CONNECT_SECONDS:g} s{why}; expected "
                "an address such as tcp://host:8786, or a scheduler file"
            ) from error
        try:
            yield Cluster(address, client)
        finally:
            client.close(CONNECT_SECONDS)


class Cluster:
    """The workers of a cluster. Each does one piece of work at a time.

    Args:
        address: as the user wrote it.
        client: connected to the scheduler.
    """

    def __init__(self, address: str, client: Client):
        self._address = address
        self._client = client
        self._workers = set(client.nthreads())
        if not self._workers:
            logger.warning("%s: no worker yet; the work begins when one joins", address)
        client.subscribe_topic("all", self._notice)

    def results(
        self, function: Callable[[Item], Result], items: Iterable[Item], shared: Path
    ) -> Iterator[tuple[Item, Result]]:
        """Each item with its result, in order of completion. When the iteration ends early, queued
        work is cancelled; work that has begun ends by itself.

        Args:
            function: pickled once per item; it may run again for an item whose worker died.
            items: hashable.
            shared: absolute path of a file that all machines must see.

        Raises:
            Exception: those of the function.
            DataError: if a worker does not see ``shared``, or has other versions than this process.
            LostWorkError: at the end, with all items whose workers died time and again.
            PointSplatError: if the scheduler ends.
        """
        from distributed import KilledWorker

        call: _Call[Item, Result] = _Call(pickle.dumps(function), _versions(), shared)
        suspects = []
        for item, future in self._finished(call, items):
            try:
                result = self._result(future)
            except KilledWorker:
                suspects.append(item)
                continue
            yield item, result
        # dask also blames what was queued at a worker that died. Alone, only the guilty fail again.
        reasons = {}
        for item in suspects:
            for _, future in self._finished(call, [item]):
                try:
                    result = self._result(future)
                except KilledWorker as error:
                    reasons[item] = (
                        f"{error.allowed_failures + 1} workers died of it, the last at "
                        f"{error.last_worker.address}, probably because memory ran out"
                    )
                    continue
                yield item, result
        if reasons:
            raise LostWorkError(reasons)

    def _finished(
        self, call: _Call[Item, Result], items: Iterable[Item]
    ) -> Iterator[tuple[Item, Future]]:
        """Each item with its finished task."""
        from distributed import as_completed

        items = list(items)
        name = f"pointsplat-{uuid.uuid4().hex}"
        keys = [(name, number) for number in range(len(items))]
        tasks = dict(zip(self._client.map(call, items, key=keys, pure=False), items, strict=True))
        try:
            for future in as_completed(tasks, loop=self._client.loop):
                yield tasks[future], future
        finally:
            self._client.cancel([future for future in tasks if not future.done()])

    def _result(self, future: Future) -> Any:
        try:
            return future.result()
        except CancelledError as error:
            raise PointSplatError(
                f"{self._address}: the scheduler ended, or the connection broke; run the same "
                "command to resume"
            ) from error
        except ModuleNotFoundError as error:
            raise DataError(
                f"{self._address}: a worker has no {error.name}; expected the same pointsplat-ns "
                "on all machines"
            ) from error

    def _notice(self, event: tuple[float, dict[str, Any]]) -> None:
        """Say that a worker died, or that none is left."""
        _, news = event
        if news.get("action") == "add-worker":
            self._workers.add(news["worker"])
        elif news.get("action") == "remove-worker":
            self._workers.discard(news["worker"])
            if news["processing-tasks"]:
                logger.warning("worker %s is lost; others repeat its work", news["worker"])
            if not self._workers:
                logger.warning("%s: no worker is left; waiting for one", self._address)


_one_at_a_time = threading.Lock()
"""Held by the thread that works: the number of threads of a piece of work is that of a process."""


@dataclass(frozen=True)
class _Call(Generic[Item, Result]):
    """Calls a function on a worker."""

    function: bytes
    """Pickled, so that nothing of it is read before versions are compared."""
    versions: str
    shared: Path

    def __call__(self, item: Item) -> Result:
        host = socket.gethostname()
        if _versions() != self.versions:
            raise DataError(
                f"a worker on {host} has {_versions()}; expected {self.versions}, as here, because "
                "others may give other results"
            )
        if not self.shared.exists():
            raise DataError(
                f"{self.shared}: missing on {host}; expected scenes and results in a folder that "
                "all machines of the cluster have under the same path"
            )
        with _one_at_a_time:
            result: Result = pickle.loads(self.function)(item)
        return result


def _versions() -> str:
    """Versions on which the bits of results depend. A local part, as in 2.6.0+cpu, says how torch
    was built."""
    torch_version = torch.__version__.partition("+")[0]
    return f"pointsplat-ns {pointsplat_ns.__version__} with torch {torch_version}"


def _scheduler(address: str) -> str:
    """The address in a scheduler file, or the address itself. Raises DataError if the file cannot
    be used."""
    if not address.endswith(".json"):
        return address
    try:
        found = json.loads(read_text(Path(address)))["address"]
        if isinstance(found, str):
            return found
        why = "its address is no text"
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        why = one_line(error)
    raise DataError(
        f"{address}: not a scheduler file ({why}); expected one that dask scheduler "
        "--scheduler-file writes"
    )


def _probe(address: str) -> None:
    """Raise an error unless a scheduler answers in time. dask's own client waits without end for
    the first word of a program that accepts connections and says nothing."""
    from distributed.core import connect
    from distributed.security import Security

    async def greeting() -> None:
        options = Security().get_connection_args("client")
        comm = await asyncio.wait_for(
            connect(address, timeout=CONNECT_SECONDS, **options), CONNECT_SECONDS
        )
        await comm.close()

    with ThreadPoolExecutor(1) as thread:  # this one may have an event loop, as in a notebook
        thread.submit(asyncio.run, greeting()).result()


@contextmanager
def _quiet() -> Iterator[None]:
    """Inside of this context, dask does not log to the terminal: errors that matter are raised."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [one.level for one in loggers]
    for one in loggers:
        one.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for one, level in zip(loggers, levels, strict=True):
            one.setLevel(level)
