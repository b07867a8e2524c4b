"""Kernels, which an installation builds where there is a compiler; cores and threads."""

import ctypes
import math
import os
import re
import shutil
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system import kernels
from pointsplat_ns.system.cores import cores, cpu_quota
from pointsplat_ns.system.kernels import KERNELS, Kernels, structs_of
from pointsplat_ns.system.native import INCLUDE, IS_X86, cpp_files, library_path
from pointsplat_ns.system.threads import fixed_threads

COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")


@needs_compiler
@pytest.mark.parametrize("source", cpp_files(), ids=lambda source: source.stem)
def test_structs_are_laid_out_as_the_compiler_lays_them_out(source, tmp_path):
    text = source.read_text("utf-8")
    included = [source.with_name(name) for name in re.findall(r'^#include "(.+)"$', text, re.M)]
    structs = structs_of(
        "".join(path.read_text("utf-8") for path in (*included, source) if path.is_file())
    )
    assert structs
    lines = ["#include <cstddef>", f'#include "{source}"']
    for name, struct in structs.items():
        lines.append(f"static_assert(sizeof({name}) == {ctypes.sizeof(struct)});")
        places = {field: getattr(struct, field).offset for field, _ in struct._fields_}
        lines += [
            f"static_assert(offsetof({name}, {field}) == {place});"
            for field, place in places.items()
        ]
    check = tmp_path / "check.cpp"
    check.write_text("\n".join(lines) + "\n", "utf-8")
    subprocess.run(
        [COMPILER, "-std=c++17", "-fsyntax-only", f"-I{INCLUDE}", str(check)], check=True
    )


def test_a_library_that_is_missing_old_or_damaged_is_not_loaded(tmp_path):
    how = "installing builds them if there is a C++ compiler (in a clone: pip install -e .)"
    library = tmp_path / "kernels.0123456789abcdef.so"
    assert Kernels(library).why_missing == f"not built; {how}"
    (tmp_path / "kernels.0123456789abcdee.so").touch()
    assert Kernels(library).why_missing == f"built from other sources; {how}"
    library.write_bytes(b"no library")
    assert Kernels(library).why_missing.startswith(f"{library}: ")


@pytest.mark.skipif(not IS_X86, reason="other processors have all that the kernels need")
def test_a_processor_without_avx2_loads_no_library(monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    assert "AVX2" in Kernels(library_path()).why_missing


def test_a_change_of_any_source_gives_the_library_another_name(monkeypatch):
    names = {library_path().name}
    read = Path.read_bytes
    changed = [cpp_files()[0], cpp_files("*.h")[-1]]
    for source in changed:
        monkeypatch.setattr(
            Path, "read_bytes", lambda path, source=source: read(path) + b"\n" * (path == source)
        )
        names.add(library_path().name)
    assert len(names) == 3


@needs_compiler
def test_where_there_is_a_compiler_kernels_are_used():
    """Tests of kernels skip where none can be used; this one tells of a library that is missing or
    old."""
    assert KERNELS.why_missing == ""


def test_ctrl_c_waits_for_threads_that_use_the_memory_of_the_call():
    caller = threading.get_ident()
    ended = []

    def function(_):
        if threading.get_ident() == caller:
            raise KeyboardInterrupt
        time.sleep(0.2)
        ended.append(threading.get_ident())

    with fixed_threads(3), pytest.raises(KeyboardInterrupt):
        kernels.on_threads(True, function)
    assert len(ended) == 2


def test_a_program_that_is_ending_calls_kernels_in_its_main_thread_alone(monkeypatch):
    pool = ThreadPoolExecutor(1)
    called = []
    pool.shutdown()
    monkeypatch.setattr(kernels, "pool", lambda name, count: pool)
    with fixed_threads(3):
        kernels.on_threads(True, lambda _: called.append(threading.get_ident()))
        assert called == [threading.get_ident()]
        with (
            ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(3,)) as other,
            pytest.raises(SystemExit),
        ):
            other.submit(kernels.on_threads, True, lambda _: called.append(None)).result()
    assert called == [threading.get_ident()]


@pytest.mark.parametrize("variable", [None, "7"])
def test_a_fixed_number_of_threads_holds_for_torch_and_started_programs(monkeypatch, variable):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if variable is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", variable)
    before = torch.get_num_threads()
    with pytest.raises(KeyError), fixed_threads(before + 2):
        assert torch.get_num_threads() == before + 2
        assert os.environ["OMP_NUM_THREADS"] == str(before + 2)
        raise KeyError
    assert torch.get_num_threads() == before and os.environ.get("OMP_NUM_THREADS") == variable


def machine(root: Path, cgroup: str, **files: str) -> Path:
    """A folder with what Linux says of a process's control groups; ``files`` by their paths below
    sys/fs/cgroup."""
    for name, text in {
        "proc/self/cgroup": cgroup,
        **{f"sys/fs/cgroup/{k}": v for k, v in files.items()},
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, "utf-8")
    return root


def test_quotas_of_control_groups_are_read(tmp_path):
    nested = {
        "cpu.max": "max 100000",
        "a/cpu.max": "150000 100000\n",
        "a/b/cpu.max": "400000 100000",
    }
    assert cpu_quota(machine(tmp_path / "v2", "0::/a/b\n", **nested)) == 1.5
    assert (
        cpu_quota(machine(tmp_path / "none", "0::/a\n", **{"a/cpu.max": "max 100000\n"}))
        == math.inf
    )
    inside = machine(
        tmp_path / "container", "0::/as/the/host/sees/it\n", **{"cpu.max": "300000 100000"}
    )
    assert cpu_quota(inside) == 3
    assert cpu_quota(tmp_path / "another system") == math.inf
    broken = machine(tmp_path / "broken", "what is this\n2:cpu:/a\n0::/a\n", **{"a/cpu.max": "0 0"})
    assert cpu_quota(broken) == math.inf


@pytest.mark.parametrize(
    ("quota", "expected"), [(math.inf, 4), (1.5, 1), (0.2, 1), (3.0, 3), (64.0, 4)]
)
def test_cores_are_those_of_the_affinity_and_the_quota(monkeypatch, quota, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2, 4, 6}, raising=False)
    monkeypatch.setattr("pointsplat_ns.system.cores.cpu_quota", lambda: quota)
    assert cores() == expected


@pytest.mark.parametrize("count", [0, 1_000_000])
def test_numbers_of_threads_that_nothing_has_are_refused(count):
    with (
        pytest.raises(PointSplatError, match=f"{count} threads; expected 1 to 1024"),
        fixed_threads(count),
    ):
        pass
