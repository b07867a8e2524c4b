"""How many threads share work, and work that they share."""

import threading
import time

import pytest
import torch

from pointsplat_ns.system import cores as cores_module
from pointsplat_ns.system import threads as threads_module
from pointsplat_ns.system.cores import OtherPrograms, cores
from pointsplat_ns.system.threads import (
    fixed_threads,
    most_threads,
    one_thread_each,
    parallel_for,
    parallel_map,
)

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("variable", "allowed", "quota", "threads"),
    [
        (None, 16, 64.0, 12),
        (None, 4, 64.0, 4),
        (None, 16, 2.5, 2),
        (None, 16, 0.1, 1),
        ("12", 4, 2.5, 12),
    ],
)
def test_as_many_threads_share_work_as_there_are_cores_unless_the_user_says_so(
    monkeypatch, variable, allowed, quota, threads
):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if variable:
        monkeypatch.setenv("OMP_NUM_THREADS", variable)
    monkeypatch.setattr(cores_module, "_allowed", lambda: [*range(allowed)])
    monkeypatch.setattr(cores_module, "cpu_quota", lambda: quota)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 12)
    assert most_threads() == threads


def test_torch_has_one_thread_and_pieces_of_work_all_until_the_context_ends():
    before = torch.get_num_threads()
    with fixed_threads(3):
        with pytest.raises(KeyError), one_thread_each():
            with one_thread_each():
                assert (torch.get_num_threads(), most_threads()) == (1, 3)
            assert (torch.get_num_threads(), most_threads()) == (1, 3)
            meet = threading.Barrier(3)  # passed only if so many are there at once
            parallel_for(lambda item: meet.wait(30), range(3), CPU)
            raise KeyError
        assert (torch.get_num_threads(), most_threads()) == (3, 3)
    assert torch.get_num_threads() == before


@pytest.mark.parametrize("inside", [1, 2])
def test_results_come_in_order_from_threads_of_the_callers_mode(inside):
    def look(item: int) -> tuple[int, int, int, bool]:
        time.sleep(0.01 * (item == 0))
        return item, torch.get_num_threads(), most_threads(), torch.is_grad_enabled()

    for grad in (True, False):
        with fixed_threads(2), torch.set_grad_enabled(grad):
            assert [*parallel_map(look, range(5), CPU, inside)] == [
                (item, inside, inside, grad) for item in range(5)
            ]
            assert [*parallel_map(look, [7], CPU)] == [(7, 2, 2, grad)], (
                "one piece of work is done here"
            )


@pytest.mark.parametrize("error", [KeyError, KeyboardInterrupt])
def test_nothing_runs_any_more_after_an_error(error):
    ended = []
    begun = threading.Event()

    def work(item: int) -> None:
        if item == 0:
            begun.wait(30)
            raise error
        begun.set()
        time.sleep(0.2)
        ended.append(item)

    with fixed_threads(2), pytest.raises(error):
        parallel_for(work, range(50), CPU)
    count = len(ended)
    time.sleep(0.3)
    assert len(ended) == count < 49


def test_threads_are_started_once():
    found = set()
    with fixed_threads(2):
        for _ in range(20):
            parallel_for(lambda item: found.add(threading.get_ident()), range(4), CPU)
    assert len(found) <= 2 and threads_module._pool.cache_info().hits >= 19


def test_a_real_look_sees_what_others_leave():
    others = OtherPrograms()
    end = time.process_time() + 0.3
    while time.process_time() < end:
        pass
    (start, own, limit, used) = others.before
    (now, own_after, _, used_after) = cores_module._usage()
    assert limit >= cores() and used_after - used > 0.2 and now > start and own_after > own
    assert 0 <= others.cores() <= cores()
