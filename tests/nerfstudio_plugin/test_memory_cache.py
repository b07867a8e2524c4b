"""What is kept in memory, and what is dropped when there is no more room."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import pytest

from pointsplat_ns.nerfstudio_plugin.frames import CacheKey, MemoryCache


@dataclass(frozen=True)
class Name(CacheKey[str]):
    number: int


@dataclass(frozen=True)
class OtherName(CacheKey[list]):
    number: int


def test_what_was_put_in_comes_out_and_keys_of_two_kinds_never_meet():
    cache = MemoryCache(10)
    value = ["kept"]
    cache.put(OtherName(1), value, 4)
    assert cache.get(OtherName(1)) is value and cache.get(Name(1)) is None


GET = None
"""In place of a value and its size: the key is only asked for."""


@pytest.mark.parametrize(
    ("limit", "steps", "kept", "size"),
    [
        (10, [(1, ("a", 4)), (2, ("b", 3))], {1: "a", 2: "b"}, 7),
        (10, [(1, ("old", 4)), (1, ("new", 6))], {1: "new"}, 6),
        (3, [(1, ("a", 1)), (2, ("b", 1)), (3, ("c", 1)), (1, GET), (4, ("d", 1))], {1: "a", 3: "c", 4: "d"}, 3),
        (10, [*((number, ("a", 2)) for number in range(5)), (9, ("large", 5))], {3: "a", 4: "a", 9: "large"}, 9),
        (10, [(1, ("small", 4)), (2, ("too large", 11))], {1: "small"}, 4),
        (10, [(1, ("old", 4)), (1, ("grown too large", 11))], {}, 0),
        (0, [(1, ("a", 1))], {}, 0),
    ],
    ids=["sum", "again", "longest unused", "as many as needed", "too large", "grown", "no room"],
)
def test_what_is_kept_within_the_limit_and_its_size(limit, steps, kept, size):
    cache = MemoryCache(limit)
    for number, step in steps:
        cache.get(Name(number)) if step is GET else cache.put(Name(number), *step)
    assert {number: value for number in range(10) if (value := cache.get(Name(number)))} == kept
    assert (cache.num_bytes, len(cache)) == (size, len(kept))


def test_the_bound_holds_while_many_threads_put_and_get():
    cache = MemoryCache(10)
    above, wrong = [], []

    def work(seed):
        for step in range(300):
            number = (7 * step + seed) % 12
            cache.put(Name(number), str(number), 1 + number % 4)
            if cache.num_bytes > cache.max_bytes:
                above.append(cache.num_bytes)
            if cache.get(Name(number)) not in (None, str(number)):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (above, wrong) == ([], [])
