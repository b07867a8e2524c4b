"""One measurement at a time; and whether others keep the machine busy."""

import threading

import pytest
import torch

from pointsplat_ns.tradeoff import machine
from pointsplat_ns.tradeoff.machine import OtherPrograms, is_busy, one_at_a_time


def test_a_second_measurement_waits_for_the_first_and_says_so():
    said, entered = [], threading.Event()

    def second() -> None:
        with one_at_a_time(lambda what, share: said.append(what)) as alone:
            assert alone
            entered.set()

    with one_at_a_time(lambda what, share: None):
        other = threading.Thread(target=second)
        other.start()
        assert not entered.wait(0.3)
        assert said == ["waiting for another measurement on this machine"]
    assert entered.wait(10)
    other.join()


def test_the_lock_is_given_back_after_an_error():
    for _ in range(2):
        with pytest.raises(RuntimeError), one_at_a_time(lambda what, share: None) as alone:
            assert alone
            raise RuntimeError


def test_cores_that_other_programs_use_are_counted_and_our_own_are_not(monkeypatch):
    """By what the system says of processor time: 8 s of all cores, 3 s of them ours, within 2 s."""
    readings = iter([(10.0, 100.0, 50.0), (12.0, 108.0, 53.0)])
    monkeypatch.setattr(OtherPrograms, "_read", staticmethod(lambda: next(readings)))
    assert OtherPrograms().cores() == 2.5


def test_a_machine_is_busy_when_too_few_cores_are_left(monkeypatch):
    monkeypatch.setattr(machine, "cores", lambda: 4)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert [is_busy(others) for others in (0.0, 2.0, 2.3, 4.0)] == [False, False, True, True]
