"""Processes that share work: threads, errors, and their end."""

import os

import psutil
import pytest
import torch

from killing import where
from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.system.cores import cores
from pointsplat_ns.system.threads import fixed_threads, one_thread_each
from pointsplat_ns.system.workers import Workers, check_jobs


def test_processes_share_the_cores_pass_errors_on_and_end_with_the_context(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    with Workers(where, 2) as workers:
        found = dict(workers.results([0.5, 0.6, 0.7]))
        assert {threads for _, threads in found.values()} == {max(1, cores() // 2)}
        with pytest.raises(DataError, match="too short"):
            list(workers.results([600.0, 0.0]))
    assert torch.get_num_threads() == before and "OMP_NUM_THREADS" not in os.environ
    assert os.getpid() not in {pid for pid, _ in found.values()}
    assert not any(psutil.pid_exists(pid) for pid, _ in found.values())


def test_processes_have_the_users_number_of_threads_where_torch_has_one_here():
    with fixed_threads(2), one_thread_each(), Workers(where, 2) as workers:
        assert {threads for _, (_, threads) in workers.results([0.1, 0.2])} == {2}


def test_a_process_that_is_killed_ends_the_work_with_one_error():
    with (
        Workers(where, 2) as workers,
        pytest.raises(PointSplatError, match="a process was killed, probably because"),
    ):
        list(
            workers.results([1.0, -0.1])
        )  # noticed at the latest when another process has a result


def test_one_job_is_done_in_this_process_and_none_is_refused():
    with Workers(where, 1) as workers:
        assert list(workers.results([0.1])) == [(0.1, (os.getpid(), torch.get_num_threads()))]
    with pytest.raises(DataError, match="jobs is 0; expected 1 or more"):
        check_jobs(0)
