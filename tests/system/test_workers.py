"""Processes that share work: threads, errors, and their end."""

import os

import psutil
import pytest
import torch

from killing import where
from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.system import workers
from pointsplat_ns.system.cores import cores
from pointsplat_ns.system.threads import fixed_threads, one_thread_each
from pointsplat_ns.system.workers import Workers, check_jobs


def test_processes_share_the_cores_pass_errors_on_and_end_with_the_context(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    with Workers(where, 2) as started:
        found = dict(started.results([0.5, 0.6, 0.7]))
        assert {threads for _, threads in found.values()} == {max(1, cores() // 2)}
        with pytest.raises(DataError, match="too short"):
            list(started.results([600.0, 0.0]))
    assert torch.get_num_threads() == before and "OMP_NUM_THREADS" not in os.environ
    assert os.getpid() not in {pid for pid, _ in found.values()}
    assert not any(psutil.pid_exists(pid) for pid, _ in found.values())


def test_processes_have_the_users_number_of_threads_where_torch_has_one_here():
    with fixed_threads(2), one_thread_each(), Workers(where, 2) as started:
        assert {threads for _, (_, threads) in started.results([0.1, 0.2])} == {2}


def test_a_process_that_is_killed_ends_the_work_with_one_error():
    with (
        Workers(where, 2) as started,
        pytest.raises(PointSplatError, match="a process was killed, probably because"),
    ):
        list(
            started.results([1.0, -0.1])
        )  # noticed at the latest when another process has a result


def test_processes_do_not_import_what_lies_in_the_current_folder(tmp_path, monkeypatch):
    if not workers.HAS_SAFE_PATH:
        pytest.skip("Python 3.10 refuses such a folder")
    mark = tmp_path / "mark"
    for name in ("multiprocessing", "pickle", "encodings", "torch"):
        (tmp_path / f"{name}.py").write_text(f"open({str(mark)!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(workers.SAFE_PATH_VARIABLE, raising=False)
    with Workers(where, 2) as started:
        assert len(list(started.results([0.1, 0.2]))) == 2
    assert not mark.exists()
    assert workers.SAFE_PATH_VARIABLE not in os.environ


def test_an_old_python_refuses_a_folder_that_would_be_imported(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "HAS_SAFE_PATH", False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "train.py").touch()
    workers._need_no_shadows(tmp_path)
    (tmp_path / "pickle.py").touch()
    with (
        pytest.raises(PointSplatError, match="pickle.py: Python 3.10 would import it"),
        Workers(where, 2),
    ):
        pass


def test_one_job_is_done_in_this_process_and_none_is_refused():
    with Workers(where, 1) as started:
        assert list(started.results([0.1])) == [(0.1, (os.getpid(), torch.get_num_threads()))]
    with pytest.raises(DataError, match="jobs is 0; expected 1 or more"):
        check_jobs(0)
