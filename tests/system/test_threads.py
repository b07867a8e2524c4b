"""Pieces of work on several threads."""

from __future__ import annotations

import threading

import pytest
import torch

from pointsplat_ns.system.threads import in_threads


@pytest.mark.parametrize("threads", [1, 3])
def test_every_item_is_worked_on_once_with_one_thread_of_torch(monkeypatch, threads):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    results, used = torch.zeros(100), set()

    def work(index: int) -> None:
        results[index] += index
        used.add(threading.get_ident())

    in_threads(work, range(100))
    assert torch.equal(results, torch.arange(100.0))
    assert (threading.get_ident() in used) == (threads == 1)


def test_the_callers_threads_stay_as_they_are():
    before = torch.get_num_threads()
    in_threads(lambda item: None, range(10))
    assert torch.get_num_threads() == before


def test_an_error_reaches_the_caller(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)

    def fail(item: int) -> None:
        raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match="item 0"):
        in_threads(fail, range(5))
