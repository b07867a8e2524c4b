"""The number of threads on a busy machine: by looks at a machine that is made up, and by a real one."""

import math
import os
import threading

import pytest
import torch

from pointsplat_ns.system import threads
from pointsplat_ns.system.threads import (
    Load,
    fixed_threads,
    in_threads,
    most_threads,
    shared_operations,
    suitable_threads,
)

CORES = 4


class Machine:
    """A clock, and threads that stall when they are told to."""

    def __init__(self):
        self.now, self.stalled, self.looks = 0.0, False, 0
        self.load = Load(self.seconds, lambda: self.now)

    def seconds(self, count: int, bound: float) -> float:
        self.looks += count > 1
        seconds = 0.001 if count == 1 or not self.stalled else min(bound + 0.02, 1.0)
        self.now += seconds
        return seconds

    def stalls(self, after: float = 0.0) -> bool:
        self.now += after
        return self.load.stalls(CORES)


@pytest.fixture
def machine(monkeypatch):
    """Four cores, of which torch uses all, in a machine that is made up."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(threads, "cores", lambda: CORES)
    made_up = Machine()
    monkeypatch.setattr(threads, "machine", made_up.load)
    before = torch.get_num_threads()
    torch.set_num_threads(CORES)
    yield made_up
    torch.set_num_threads(before)


def used(device: torch.device | None = None) -> int:
    with suitable_threads(device):
        return torch.get_num_threads()


def test_all_threads_are_used_while_they_do_not_stall_else_one(machine):
    assert used() == CORES
    machine.stalled, machine.now = True, 10.0
    assert used() == 1 and torch.get_num_threads() == CORES


def test_one_bad_look_is_enough_and_three_good_ones_are_needed(machine):
    machine.stalls()
    machine.stalled = True
    assert machine.stalls(after=1)
    machine.stalled = False
    assert [machine.stalls(after=2) for _ in range(3)] == [True, True, False]


def test_the_callers_threads_are_restored_also_after_an_error(machine):
    machine.stalled = True
    with pytest.raises(KeyboardInterrupt), suitable_threads():
        assert torch.get_num_threads() == 1
        raise KeyboardInterrupt
    assert torch.get_num_threads() == CORES and most_threads() == CORES
    assert used() == 1, "it goes on choosing"


@pytest.mark.parametrize("count", [1, 3])
def test_nothing_is_chosen_where_the_user_has(machine, count):
    machine.stalled = True
    with fixed_threads(count):
        assert used() == count
    assert torch.get_num_threads() == CORES and "OMP_NUM_THREADS" not in os.environ


def test_pieces_that_do_not_wait_use_all_threads_in_a_step_on_one(machine):
    machine.stalled = True
    meet = threading.Barrier(CORES)  # passed only if so many are there at once
    with suitable_threads():
        assert torch.get_num_threads() == 1
        in_threads(lambda item: meet.wait(30), range(CORES))


def test_a_real_look_works_in_every_mode_of_torch_and_changes_nothing():
    before = torch.get_num_threads()
    threads._numbers.cache_clear()
    with torch.inference_mode():
        assert shared_operations(1, math.inf) > 0
    assert shared_operations(1, math.inf) > 0
    with suitable_threads():
        assert 1 <= torch.get_num_threads() <= before
    assert torch.get_num_threads() == before
