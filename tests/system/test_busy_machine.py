"""The number of threads beside other programs: on machines that are made up, and on a real one."""

import math
import os
import threading
import time
from types import SimpleNamespace

import pytest
import torch

from pointsplat_ns.system import cores as cores_module
from pointsplat_ns.system.cores import FreeCores
from pointsplat_ns.system.threads import fixed_threads, in_threads, suitable_threads
from pretend_gpu import GPU


class Machine:
    """Cores of which this process and others use some, by a clock of its own."""

    def __init__(self):
        self.count, self.now, self.own, self.looks = 16, 0.0, 0.0, 0
        self.own_uses = self.others_use = 0.0  # cores
        self.used = 0.0

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.own += self.own_uses * seconds
        self.used += (self.own_uses + self.others_use) * seconds

    def usage(self) -> tuple[float, float, int, float]:
        self.looks += 1
        return self.now, self.own, self.count, self.used


@pytest.fixture
def machine(monkeypatch):
    """Sixteen cores, of which torch uses all, in a machine that is made up."""
    made_up = Machine()
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(cores_module, "time", SimpleNamespace(monotonic=lambda: made_up.now, sleep=made_up.wait))
    monkeypatch.setattr(cores_module, "_usage", made_up.usage)
    monkeypatch.setattr(cores_module, "_allowed", lambda: [*range(made_up.count)])
    monkeypatch.setattr(cores_module, "cpu_quota", lambda: math.inf)
    monkeypatch.setattr("pointsplat_ns.system.threads.free_cores", FreeCores())
    before = torch.get_num_threads()
    torch.set_num_threads(made_up.count)
    yield made_up
    torch.set_num_threads(before)


def used(device: torch.device | None = None) -> int:
    with suitable_threads(device):
        return torch.get_num_threads()


@pytest.mark.parametrize(
    ("count", "others", "threads"),
    [(16, 0.0, 16), (16, 2.1, 14), (16, 16.0, 1), (2, 0.3, 2), (2, 2 / 3, 1)],
)
def test_as_many_threads_are_used_as_other_programs_leave_cores(machine, count, others, threads):
    machine.count, machine.others_use = count, others
    assert used() == threads


def test_the_machine_is_looked_at_once_a_second_and_the_number_follows(machine):
    assert [used() for _ in range(5)] == [16] * 5
    looks = machine.looks
    machine.wait(0.9)
    assert used() == 16 and machine.looks == looks
    machine.others_use = 8.0
    machine.wait(0.9)
    assert used() == 12, "half of the time since the last look was before"
    machine.wait(1.0)
    assert used() == 8
    machine.others_use = 0.0
    machine.wait(1.0)
    assert used() == 16


@pytest.mark.parametrize(
    ("quota", "on_machine", "threads"), [(4.0, 40.0, 4), (4.0, 62.0, 2), (2.5, 0.0, 2), (100.0, 10.0, 54)]
)
def test_in_a_container_the_hosts_load_counts_only_where_it_is_full(machine, monkeypatch, quota, on_machine, threads):
    machine.count, machine.others_use = 64, on_machine
    monkeypatch.setattr(cores_module, "cpu_quota", lambda: quota)
    torch.set_num_threads(64)
    assert used() == threads


@pytest.mark.parametrize("count", [1, 3])
def test_nothing_is_chosen_where_the_user_has_or_on_a_gpu(machine, count):
    machine.others_use = 15.0
    with fixed_threads(count):
        assert used() == count
    assert used(GPU) == 16
    assert torch.get_num_threads() == 16 and "OMP_NUM_THREADS" not in os.environ


def test_pieces_that_do_not_wait_use_all_threads_in_a_step_on_one(machine):
    machine.count, machine.others_use = 4, 4.0
    meet = threading.Barrier(4)  # passed only if so many are there at once
    with suitable_threads():
        assert torch.get_num_threads() == 1
        in_threads(lambda item: meet.wait(30), range(4), torch.device("cpu"))


def test_a_real_look_sees_this_process_work_and_changes_nothing():
    before, (start, own, limit, used) = torch.get_num_threads(), cores_module._usage()
    while time.process_time() - own < 0.3:
        pass
    end, own_after, _, used_after = cores_module._usage()
    assert limit >= cores_module.cores() and used_after - used > 0.2 and end > start and own_after > own
    with torch.inference_mode(), suitable_threads():
        assert 1 <= torch.get_num_threads() <= max(before, 1)
    assert torch.get_num_threads() == before
