"""Pieces of work on several threads, and the cores that there are for them."""

import os
import threading
from pathlib import Path

import pytest
import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.threads import cores, cpu_quota, fixed_threads, in_threads


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


@pytest.mark.parametrize("variable", [None, "7"])
def test_a_fixed_number_of_threads_is_that_of_torch_and_of_programs_that_are_started(monkeypatch, variable):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if variable is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", variable)
    before = torch.get_num_threads()
    with pytest.raises(KeyError), fixed_threads(before + 2):
        assert torch.get_num_threads() == before + 2
        assert os.environ["OMP_NUM_THREADS"] == str(before + 2)
        raise KeyError
    assert torch.get_num_threads() == before and os.environ.get("OMP_NUM_THREADS") == variable


@pytest.mark.parametrize("count", [0, 1_000_000])
def test_numbers_of_threads_that_nothing_has_are_refused(count):
    with pytest.raises(PointSplatError, match=f"{count} threads; expected 1 to 1024"), fixed_threads(count):
        pass


def machine(root: Path, cgroup: str, **files: str) -> Path:
    """A folder with what Linux says of a process's control groups; ``files`` by their paths below sys/fs/cgroup."""
    for name, text in {"proc/self/cgroup": cgroup, **{f"sys/fs/cgroup/{k}": v for k, v in files.items()}}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, "utf-8")
    return root


def test_quotas_of_control_groups_are_read(tmp_path):
    nested = {"cpu.max": "max 100000", "a/cpu.max": "150000 100000\n", "a/b/cpu.max": "400000 100000"}
    assert cpu_quota(machine(tmp_path / "v2", "0::/a/b\n", **nested)) == 1.5
    assert cpu_quota(machine(tmp_path / "none", "0::/a\n", **{"a/cpu.max": "max 100000\n"})) is None
    inside = machine(tmp_path / "container", "0::/as/the/host/sees/it\n", **{"cpu.max": "300000 100000"})
    assert cpu_quota(inside) == 3
    old = {"cpu,cpuacct/a/cpu.cfs_quota_us": "250000", "cpu,cpuacct/a/cpu.cfs_period_us": "100000"}
    assert cpu_quota(machine(tmp_path / "v1", "3:cpuset:/a\n2:cpu,cpuacct:/a\n", **old)) == 2.5
    unlimited = {"cpu/a/cpu.cfs_quota_us": "-1", "cpu/a/cpu.cfs_period_us": "100000"}
    assert cpu_quota(machine(tmp_path / "v1 free", "2:cpu:/a\n", **unlimited)) is None
    assert cpu_quota(tmp_path / "another system") is None
    assert cpu_quota(machine(tmp_path / "broken", "what is this\n0::/a\n", **{"a/cpu.max": "0 0"})) is None


@pytest.mark.parametrize(("quota", "expected"), [(None, 4), (1.5, 1), (0.2, 1), (3.0, 3), (64.0, 4)])
def test_cores_are_those_of_the_affinity_and_the_quota(monkeypatch, quota, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2, 4, 6}, raising=False)
    monkeypatch.setattr("pointsplat_ns.system.threads.cpu_quota", lambda: quota)
    assert cores() == expected
