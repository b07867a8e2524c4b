"""Values that are made in a thread before they are needed."""

from __future__ import annotations

import atexit
import threading
from collections import deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Any, TypeVar

import torch

from pointsplat_ns.system.threads import most_threads

Value = TypeVar("Value")

NAME = "background"
"""Name of the thread."""


class StoppedError(Exception):
    """Raised in the thread, and given by what it was making, because the program no longer needs it."""


class Background:
    """Makes values in one thread, one after the other in the order in which they were asked for, while the program does
    other things. Whoever takes a value gets what its making gives or raises, whenever that happened.

    The thread must not use a GPU: torch initialises CUDA's libraries in the first thread that needs them, and not
    safely. The thread lives while there is something to make. When the program ends, :meth:`stop` is called. Only one
    thread at a time may call the methods but :meth:`check`.
    """

    def __init__(self) -> None:
        self._coming: dict[Hashable, Future[Any]] = {}
        self._waiting: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._lock = threading.Lock()  # of the thread's beginning and end, and of what waits
        self._thread: threading.Thread | None = None
        self._stopping = False

    def start(self, key: Hashable, make: Callable[[], Any]) -> None:
        """Make a value in the background, unless one with this key is being made or waits to be taken."""
        if key in self._coming:
            return
        self._coming[key] = future = Future[Any]()
        with self._lock:
            self._waiting.append((future, make))
            if self._thread is None:
                atexit.register(self.stop)
                self._thread = threading.Thread(target=self._work, args=(most_threads(),), name=NAME, daemon=True)
                self._thread.start()

    def take(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """A value that was started, once it is made; if there is none, ``make`` it here and now."""
        future = self._coming.pop(key, None)
        return make() if future is None else future.result()

    def check(self, *_: object) -> None:
        """To be called now and then while a value is made. Raises StoppedError if it is no longer needed."""
        if self._stopping:
            raise StoppedError

    def stop(self) -> None:
        """Drop all values and wait for the thread, which ends at the next :meth:`check` or value."""
        self._coming.clear()
        with self._lock:
            for future, _ in self._waiting:  # another thread may have begun to wait for it
                future.set_exception(StoppedError())
            self._waiting.clear()
            self._stopping, thread = True, self._thread
        if thread is not None:
            thread.join()
        self._stopping = False

    def _work(self, threads: int) -> None:
        torch.set_num_threads(threads)
        while True:
            with self._lock:
                if not self._waiting:
                    self._thread = None
                    atexit.unregister(self.stop)
                    return
                future, make = self._waiting.popleft()
            try:
                future.set_result(make())
            except BaseException as error:  # whoever takes the value gets it
                future.set_exception(error)
