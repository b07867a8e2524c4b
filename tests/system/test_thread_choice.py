"""The number of threads, chosen by measuring: on a machine whose clock and speed are made up."""

from __future__ import annotations

import logging
import math
import os
import random
import threading
from collections.abc import Callable

import pytest
import torch

from pointsplat_ns.system.thread_choice import (
    CLEAR,
    LOOK_SECONDS,
    SHARE,
    Stalls,
    ThreadChoice,
    _numbers,
    shared_operations,
    unstalled_threads,
)
from pointsplat_ns.system.threads import fixed_threads, in_threads, most_threads, one_thread, one_thread_each

CORES = 4


@pytest.fixture(autouse=True)
def cores_to_choose_from(monkeypatch):
    """Four cores, of which torch uses all."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("pointsplat_ns.system.thread_choice.cores", lambda: CORES)
    before = torch.get_num_threads()
    torch.set_num_threads(CORES)
    yield
    torch.set_num_threads(before)


class Machine:
    """A clock that steps advance by what they take on the number of threads in use."""

    def __init__(self, seconds: dict[int, float], stalling: Callable[[int], bool] = lambda count: False):
        self.now, self.seconds, self.stalling = 100.0, seconds, stalling
        self.noise: Callable[[], float] = lambda: 1.0
        self.choice = ThreadChoice(lambda count: self.stalling(count), lambda: self.now)
        self.used: list[int] = []

    def step(self, items: float = 1.0) -> int:
        with self.choice.step(items):
            count = torch.get_num_threads()
            self.now += self.seconds[count] * items * self.noise()
        self.used.append(count)
        return count

    def steps(self, number: int) -> list[int]:
        return [self.step() for _ in range(number)]


def test_all_threads_stay_where_they_are_the_fastest_and_tries_cost_little():
    machine = Machine({4: 1.0, 2: 1.7, 1: 3.0})
    used = machine.steps(1000)
    assert used.count(4) > 970
    lost = machine.now - 100 - 1000
    assert lost < 2 * SHARE * 1000
    assert used.count(2) > 1, "it was tried"


def test_fewer_threads_win_where_more_are_slow():
    machine = Machine({4: 2.0, 2: 1.2, 1: 0.6})
    used = machine.steps(400)
    assert used[0] == 4 and used[-100:].count(1) > 90


def test_threads_that_stall_are_not_used_for_a_single_step():
    machine = Machine({4: 20.0, 2: 20.0, 1: 0.5}, stalling=lambda count: count > 1)
    assert set(machine.steps(300)) == {1}


def test_it_changes_at_once_when_load_comes_and_back_when_it_goes():
    machine = Machine({4: 1.0, 2: 1.7, 1: 3.0})
    assert set(machine.steps(20)) == {4}
    machine.seconds, machine.stalling = {4: 30.0, 2: 15.0, 1: 3.5}, lambda count: count > 1
    assert set(machine.steps(20)) == {1}
    machine.seconds, machine.stalling = {4: 1.0, 2: 1.7, 1: 3.0}, lambda count: False
    machine.steps(20)
    assert set(machine.steps(10)) == {4}


def test_load_that_looks_do_not_find_is_noticed_by_the_steps():
    machine = Machine({4: 1.0, 2: 1.7, 1: 3.0})
    machine.steps(30)
    machine.seconds = {4: 9.0, 2: 5.0, 1: 3.0}
    machine.steps(40)
    assert machine.used[-1] == 1


@pytest.mark.parametrize("seed", range(5))
def test_noise_does_not_make_it_go_to_and_fro(seed):
    print("seed", seed)
    generator = random.Random(seed)
    machine = Machine({4: 1.0, 2: 1.0, 1: 1.0})
    machine.noise = lambda: generator.uniform(0.7, 1.4)
    kept, changes = 4, 0
    for _ in range(2000):
        machine.step()
        changes += machine.choice.count != kept
        kept = machine.choice.count
    assert changes <= 6


@pytest.mark.parametrize("seed", range(5))
def test_the_faster_number_wins_through_noise(seed):
    print("seed", seed)
    generator = random.Random(seed)
    machine = Machine({4: 1.0, 2: 0.55, 1: 1.0})
    machine.noise = lambda: generator.uniform(0.6, 1.6)
    machine.steps(1000)
    assert machine.used[-300:].count(2) > 250


def test_steps_of_different_sizes_are_compared_by_item():
    machine = Machine({4: 0.001, 2: 0.0019, 1: 0.0036})
    size = 1_000_000.0
    while size > 1000:
        machine.step(size)
        size *= 0.9
    assert machine.choice.count == 4, "later, smaller steps are shorter on any number of threads"


def test_the_callers_threads_are_restored_also_after_an_error():
    machine = Machine({4: 20.0, 2: 20.0, 1: 0.5}, stalling=lambda count: count > 1)
    with pytest.raises(KeyboardInterrupt), machine.choice.step():
        assert torch.get_num_threads() == 1
        raise KeyboardInterrupt
    assert torch.get_num_threads() == CORES and most_threads() == CORES
    assert machine.step() == 1, "it goes on choosing"
    assert torch.get_num_threads() == CORES


@pytest.mark.parametrize("count", [1, 3])
def test_nothing_is_chosen_where_the_user_has(count):
    machine = Machine({4: 20.0, 2: 20.0, 1: 0.5}, stalling=lambda count: count > 1)
    machine.seconds[3] = 10.0
    with fixed_threads(count):
        assert set(machine.steps(20)) == {count}
        with unstalled_threads():
            assert torch.get_num_threads() == count
    assert torch.get_num_threads() == CORES and "OMP_NUM_THREADS" not in os.environ


def test_nothing_is_chosen_for_a_gpu():
    machine = Machine({1: 1.0}, stalling=lambda count: True)
    with machine.choice.step(device=torch.device("cuda")):
        assert torch.get_num_threads() == CORES


def test_no_more_threads_than_cores(monkeypatch):
    monkeypatch.setattr("pointsplat_ns.system.thread_choice.cores", lambda: 1)
    assert set(Machine({1: 1.0}).steps(20)) == {1}


def test_a_step_within_a_step_is_left_alone():
    outer = Machine({1: 1.0}, stalling=lambda count: count > 1)
    inner = Machine({1: 1.0, CORES: 1.0})
    with outer.choice.step():
        assert inner.step() == 1
        assert most_threads() == CORES
    assert inner.step() == CORES


def test_pieces_that_do_not_wait_use_all_threads_in_a_step_on_one(monkeypatch):
    machine = Machine({1: 1.0}, stalling=lambda count: count > 1)
    meet = threading.Barrier(CORES)  # passed only if so many are there at once
    with machine.choice.step():
        in_threads(lambda item: meet.wait(30), range(CORES))


def test_another_thread_of_python_is_not_measured_with_the_first():
    machine = Machine({1: 1.0, 4: 1.0}, stalling=lambda count: count > 1)
    seen = []

    def other() -> None:
        torch.set_num_threads(CORES)
        with machine.choice.step():
            seen.append(torch.get_num_threads())

    with machine.choice.step():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        assert torch.get_num_threads() == 1
    assert seen == [CORES]


class Looks:
    """Looks at a machine whose threads stall when they are told to."""

    def __init__(self):
        self.now, self.stalled, self.made = 0.0, False, 0
        self.stalls = Stalls(self.shared, lambda: self.now)

    def shared(self, count: int, bound: float) -> float:
        self.made += count > 1
        seconds = 0.001 if count == 1 or not self.stalled else min(bound + 0.02, 1.0)
        self.now += seconds
        return seconds


def test_looks_tell_whether_threads_stall_and_are_rare():
    looks = Looks()
    assert not looks.stalls(2) and not looks.stalls(1)
    before = looks.made
    for _ in range(1000):
        looks.stalls(2)
    assert looks.made == before, "no time has gone by"
    start = looks.now
    for _ in range(1000):
        looks.now += 0.01
        looks.stalls(2)
    assert (looks.made - before) * 0.002 < SHARE * (looks.now - start)


def test_one_bad_look_is_enough_and_several_good_ones_are_needed():
    looks = Looks()
    looks.stalls(2)
    looks.stalled = True
    looks.now += 2 * LOOK_SECONDS
    assert looks.stalls(2)
    looks.stalled = False
    for _ in range(CLEAR - 1):
        looks.now += 1.6 * LOOK_SECONDS  # once: the bad look was dear
        assert looks.stalls(2)
    looks.now += 2 * LOOK_SECONDS
    assert not looks.stalls(2)


def test_threads_that_stall_again_and_again_are_used_ever_more_seldom():
    looks, used = Looks(), 0
    for second in range(600):
        looks.stalled = second % 5 == 0  # busy for a second of every five
        looks.now += 1
        used += not looks.stalls(2)
    assert used < 30
    looks.stalled = False
    looks.now += 1
    for _ in range(120):
        looks.now += 1
        looks.stalls(2)
    assert not looks.stalls(2), "but they are used again"


def test_after_long_steps_it_looks_as_often_as_it_was_due():
    looks = Looks()
    looks.stalled = True
    assert looks.stalls(2)
    looks.stalled = False
    looks.now += 60
    assert not looks.stalls(2)


def test_that_the_machine_is_the_limit_is_said_once(caplog):
    looks = Looks()
    with caplog.at_level(logging.WARNING, "pointsplat_ns"):
        looks.stalls(2)
        assert not caplog.records
        looks.stalled = True
        for _ in range(30):
            looks.now += 2
            looks.stalls(2)
    [record] = caplog.records
    assert "busy" in record.getMessage() and "--threads" in record.getMessage()


def test_a_real_look_changes_nothing():
    before = torch.get_num_threads()
    with unstalled_threads():
        assert 1 <= torch.get_num_threads() <= before
    assert torch.get_num_threads() == before


def test_a_real_look_works_in_every_mode_of_torch():
    _numbers.cache_clear()
    with torch.inference_mode():
        assert shared_operations(1, math.inf) > 0
    assert shared_operations(1, math.inf) > 0


def test_contexts_of_one_thread_restore_the_callers():
    for context in (one_thread, one_thread_each):
        with pytest.raises(ValueError), context():
            assert torch.get_num_threads() == 1
            assert most_threads() == (1 if context is one_thread else CORES)
            raise ValueError
        assert torch.get_num_threads() == CORES and most_threads() == CORES
