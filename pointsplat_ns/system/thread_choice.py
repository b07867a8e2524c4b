"""How many threads torch uses for a step of long work, chosen by measuring.

Threads that share one operation wait for one another at its end. Where other programs keep the cores busy, one of them
is always late: a step on two threads was seen to take ten to forty times as long as on one. So the number is chosen
while the work goes on, from two measurements. A *look* shares a small operation between threads for some milliseconds,
and tells whether they stall. It says where to begin, keeps steps from numbers of threads that stall, and notices
when other programs start and end. Between numbers that do not stall, *tried steps* decide: now and then a few steps are
done with another number, and it is kept if they are clearly cheaper.
"""

from __future__ import annotations

import functools
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median

import torch

from pointsplat_ns.system.cores import cores
from pointsplat_ns.system.threads import ENVIRONMENT, chosen, most_threads

logger = logging.getLogger("pointsplat_ns")

Clock = Callable[[], float]

SHARE = 0.03
"""Share of the time that looks may take, and that tried steps which turn out dearer may cost."""

TRIES, USUAL = 5, 5
"""Number of steps that another number of threads is tried in, and of latest steps that these are compared with."""

GAIN = 0.8
"""Another number of threads is kept if its median step takes less than this share of the usual one; so that noise does
not make it go to and fro."""

MOST_PATIENCE = 16
"""Bound of the factor by which tries become rarer, twice with each that changes nothing."""

LOOK_SECONDS = 0.5
"""Least time between looks."""

CLEAR, MOST_CLEAR = 3, 48
"""Number of looks in a row that must find nothing before threads that have stalled are used again, as some find nothing
on a busy machine. It is doubled, up to the second number, each time that they then stall again, and is back at the
first after so many that found nothing."""

STALL = 1.5
"""Threads stall if an operation shared between them takes this many times as long as on one of them."""

_OPERATIONS, _NUMBERS = 100, 1 << 17
"""Operations of a look, and numbers in each, 0.5 MB: about 2 ms on one thread."""


class Stalls:
    """Tells whether threads that share an operation wait long for one another.

    Args:
        shared: called with a number of threads and a bound, gives the seconds that a piece of work takes on so many
            threads, or any time above the bound when that is reached.
        clock: gives the time, seconds.
    """

    def __init__(self, shared: Callable[[int, float], float], clock: Clock = time.perf_counter):
        self._shared, self._clock = shared, clock
        self._good: dict[int, int] = {}  # looks in a row that found nothing, by number of threads
        self._needed: dict[int, int] = {}  # and how many of them are needed
        self._next: dict[int, float] = {}  # when the next look is due
        self._bad, self._told = 0, False

    def __call__(self, count: int) -> bool:
        """Whether ``count`` threads stall, by the latest looks. If it is time, or nothing is known, looks first."""
        if count <= 1:
            return False
        due = CLEAR if count not in self._next else math.ceil((self._clock() - self._next[count]) / LOOK_SECONDS)
        for _ in range(min(due, CLEAR)):
            self._look(count)
        return self._good[count] < self._needed.get(count, CLEAR)

    def _look(self, count: int) -> None:
        start = self._clock()
        alone = self._shared(1, math.inf)
        stalled = self._shared(count, STALL * alone) > STALL * alone
        end = self._clock()
        self._next[count] = end + max(LOOK_SECONDS, (end - start) / SHARE)
        good, again = self._good.get(count, 0), count in self._needed
        if stalled and again and good >= self._needed[count]:
            self._needed[count] = min(2 * self._needed[count], MOST_CLEAR)
        elif stalled and not again:
            self._needed[count] = CLEAR
        elif good >= MOST_CLEAR:
            self._needed.pop(count, None)
        self._good[count] = 0 if stalled else good + 1
        self._bad = self._bad + 1 if stalled else 0
        if self._bad == CLEAR and not self._told:
            self._told = True
            logger.warning(
                "this machine is busy with other programs: torch's threads wait for one another, so fewer than %d are "
                "used for now; --threads or %s overrules that", count, ENVIRONMENT,
            )  # fmt: skip


@functools.cache
def _numbers() -> torch.Tensor:
    with torch.inference_mode(False):  # else they could be written to in that mode alone
        return torch.ones(_NUMBERS, device="cpu", dtype=torch.float32)


def shared_operations(count: int, bound: float) -> float:
    """Seconds that some operations take on so many threads; once they take longer than ``bound``, those so far."""
    numbers, before = _numbers(), torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        numbers.mul_(1.0)  # starts the threads
        start = time.perf_counter()
        seconds = 0.0
        for _ in range(_OPERATIONS):
            numbers.mul_(1.0)
            seconds = time.perf_counter() - start
            if seconds > bound:
                break
        return seconds
    finally:
        torch.set_num_threads(before)


machine_stalls = Stalls(shared_operations)
"""What is known of this machine: one for all choices of the process, so that looks are not repeated."""


def _is_open(device: torch.device | None) -> bool:
    """Whether the number of threads may be chosen here."""
    on_cpu = device is None or device.type == "cpu"
    return on_cpu and most_threads() > 1 and not chosen.settled and ENVIRONMENT not in os.environ


@contextmanager
def _from_given() -> Iterator[int]:
    """Give the number of threads to choose from; after it all is as before."""
    before, outer = torch.get_num_threads(), chosen.most
    chosen.most = min(most_threads(), cores())
    try:
        yield chosen.most
    finally:
        torch.set_num_threads(before)
        chosen.most = outer


@contextmanager
def unstalled_threads(device: torch.device | None = None) -> Iterator[None]:
    """Let torch use as many of its threads as do not stall just now: for work that is no step of many alike. Steps
    within it choose for themselves.

    Args:
        device: what computes; nothing is chosen for a GPU.
    """
    if not _is_open(device):
        yield
        return
    with _from_given() as most:
        torch.set_num_threads(_unstalled(most, machine_stalls))
        yield


def _unstalled(count: int, stalls: Callable[[int], bool]) -> int:
    """The largest number of threads up to ``count`` that does not stall."""
    while stalls(count):
        count = _fewer(count)
    return count


class ThreadChoice:
    """Chooses how many threads torch uses for steps that are alike.

    Only numbers are chosen that the caller has (``torch.get_num_threads()``) and the process gets
    (:func:`~pointsplat_ns.system.cores.cores`): all, a half, a quarter, ... and 1. After each step the caller has as
    many as before. Nothing is chosen where the environment variable ``OMP_NUM_THREADS`` is set, nor in a step
    of another choice.

    A result must not depend on the choice, which depends on the load: use it for work that gives the same bits on one
    thread and several, or for which a tolerance is stated.

    Args:
        stalls: whether a number of threads stalls; by default what is known of this machine.
        clock: gives the time, seconds.

    Example:
        >>> choice = ThreadChoice()
        >>> for image in range(3):
        ...     with choice.step():
        ...         _ = torch.ones(1000).sum()
    """

    def __init__(self, stalls: Callable[[int], bool] = machine_stalls, clock: Clock = time.perf_counter):
        self._stalls, self._clock = stalls, clock
        self._free = threading.Lock()
        self._most = 0
        self._best = 1  # the number that steps have shown to be the best
        self._at = 0  # the largest up to that which does not stall
        self._trying: int | None = None
        self._usual: deque[float] = deque(maxlen=USUAL)  # costs of the latest steps with the number kept
        self._tried: list[float] = []  # and with the one tried
        self._since = 0.0  # when the last try ended
        self._spent, self._seconds = 0.0, 0.0  # what the last try cost; what the last step took
        self._patience = 1
        self._upwards = False  # where the next try goes

    @property
    def count(self) -> int:
        """The number of threads that is kept for now."""
        return self._at

    @contextmanager
    def step(self, items: float = 1.0, device: torch.device | None = None) -> Iterator[None]:
        """Do a step with the number of threads that suits it.

        Args:
            items: how much work the step is, in any unit, such as the number of Gaussians: steps are compared by their
                time for one item.
            device: what computes it; nothing is chosen for a GPU.
        """
        # A choice that another thread of Python is just using is left alone.
        if not _is_open(device) or not self._free.acquire(blocking=False):
            yield
            return
        try:
            with _from_given() as most:
                count = self._next(most)
                torch.set_num_threads(count)
                chosen.settled = True
                start = self._clock()
                yield
                self._note(count, self._clock() - start, items)
        finally:
            chosen.settled = False
            self._free.release()

    def _next(self, most: int) -> int:
        """The number of threads of the next step."""
        if most != self._most:
            self._most = self._best = most
        at = _unstalled(self._best, self._stalls)
        if at != self._at:
            self._at = at
            self._begin([])
        if self._trying is not None and self._stalls(self._trying):
            self._give_up()
        if self._trying is None and self._at == self._best:
            self._trying = self._to_try()
        return self._at if self._trying is None else self._trying

    def _to_try(self) -> int | None:
        """A number of threads to try from the next step on, if it is time for one."""
        if len(self._usual) < 3:
            return None
        if (self._clock() - self._since) * SHARE < self._patience * max(self._seconds, self._spent):
            return None
        up, down = _more(self._at, self._most), _fewer(self._at)
        if up > self._at and self._stalls(up):
            up = self._at
        choices = [count for count in ((up, down) if self._upwards else (down, up)) if count != self._at]
        self._upwards = not self._upwards
        self._tried, self._spent = [], 0.0
        return choices[0] if choices else None

    def _note(self, count: int, seconds: float, items: float) -> None:
        """Take note of what a step took."""
        cost = seconds / items
        if count == self._at:
            if len(self._usual) == USUAL and min(cost, self._usual[-1]) > median(self._usual) / GAIN**2:
                self._begin([self._usual[-1]])  # two such steps in a row: something has changed
                self._since = -math.inf
            self._usual.append(cost)
            self._seconds = seconds
            return
        self._tried.append(cost)
        usual = median(self._usual)
        self._spent += max(0.0, seconds - usual * items)
        tried, enough = self._tried, len(self._tried) >= TRIES
        below = sum(each < usual for each in tried)
        if (enough and median(tried) < GAIN * usual and below >= TRIES - 1) or (
            len(tried) > 1 and max(tried) < 0.5 * min(self._usual)
        ):
            self._upwards = count > self._at  # and on in this direction
            self._best = self._at = count
            self._begin(tried)
            self._since = -math.inf
        elif enough or min(tried) > max(self._usual) / GAIN or (len(tried) > 1 and min(tried) > usual / GAIN):
            self._give_up()

    def _begin(self, costs: list[float]) -> None:
        """Begin with a number of threads whose latest steps had these costs."""
        self._trying, self._patience, self._since = None, 1, self._clock()
        self._usual = deque(costs, maxlen=USUAL)

    def _give_up(self) -> None:
        """End a try that has brought nothing."""
        self._trying, self._since = None, self._clock()
        self._patience = min(2 * self._patience, MOST_PATIENCE)


def _fewer(count: int) -> int:
    """The next smaller number of threads that may be chosen."""
    return max(1, count // 2)


def _more(count: int, most: int) -> int:
    """The next larger one, at most ``most``."""
    while _fewer(most) > count:
        most = _fewer(most)
    return most
