"""What is kept in memory, and what is dropped when there is no more room."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import pytest

from pointsplat_ns.nerfstudio_plugin.memory_cache import CacheKey, MemoryCache, free_memory_share


@dataclass(frozen=True)
class Name(CacheKey[str]):
    number: int


@dataclass(frozen=True)
class OtherName(CacheKey[list]):
    number: int


def test_what_was_put_in_comes_out():
    cache = MemoryCache(10)
    value = ["kept"]
    cache.put(OtherName(1), value, 4)
    assert cache.get(OtherName(1)) is value


def test_what_was_never_put_in_is_none():
    assert MemoryCache(10).get(Name(1)) is None


def test_keys_of_two_kinds_never_meet():
    cache = MemoryCache(10)
    cache.put(Name(1), "text", 4)
    assert cache.get(OtherName(1)) is None


def test_the_longest_unused_is_dropped_first():
    cache = MemoryCache(3)
    for number in (1, 2, 3):
        cache.put(Name(number), "value", 1)
    cache.get(Name(1))
    cache.put(Name(4), "value", 1)
    assert [number for number in (1, 2, 3, 4) if cache.get(Name(number))] == [1, 3, 4]


def test_a_large_value_drops_as_many_as_it_needs():
    cache = MemoryCache(10)
    for number in range(5):
        cache.put(Name(number), "value", 2)
    cache.put(Name(9), "large", 5)
    assert [number for number in range(10) if cache.get(Name(number))] == [3, 4, 9]


def test_the_size_is_the_sum_of_what_is_kept():
    cache = MemoryCache(10)
    cache.put(Name(1), "value", 4)
    cache.put(Name(2), "value", 3)
    assert (cache.num_bytes, len(cache)) == (7, 2)


def test_a_value_put_in_again_is_counted_once():
    cache = MemoryCache(10)
    cache.put(Name(1), "old", 4)
    cache.put(Name(1), "new", 6)
    assert (cache.get(Name(1)), cache.num_bytes) == ("new", 6)


def test_a_value_larger_than_the_cache_is_not_kept_and_drops_nothing_else():
    cache = MemoryCache(10)
    cache.put(Name(1), "small", 4)
    cache.put(Name(2), "large", 11)
    assert (cache.get(Name(1)), cache.get(Name(2)), cache.num_bytes) == ("small", None, 4)


def test_a_value_that_has_grown_too_large_is_dropped_rather_than_left_old():
    cache = MemoryCache(10)
    cache.put(Name(1), "old", 4)
    cache.put(Name(1), "new", 11)
    assert (cache.get(Name(1)), cache.num_bytes) == (None, 0)


def test_no_room_keeps_nothing():
    cache = MemoryCache(0)
    cache.put(Name(1), "value", 1)
    assert len(cache) == 0


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


def test_a_share_of_the_free_memory_is_less_than_the_machine_has():
    psutil = pytest.importorskip("psutil")
    assert 0 < free_memory_share(0.25) < psutil.virtual_memory().total
