"""Kernels are built by an installation where there is a compiler; where they are not, torch computes everything."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from pointsplat_ns.system import kernels
from pointsplat_ns.system.native import IS_X86, cpp_files, library_path

HOW = "where there is a C++ compiler, installing builds them (in a clone: pip install -e .)"


def test_a_library_that_is_missing_old_or_damaged_is_not_loaded(tmp_path, monkeypatch):
    library = tmp_path / "kernels.0123456789abcdef.so"
    monkeypatch.setattr(kernels, "_LIBRARY", library)
    assert kernels._why_not_loaded() == f"they were not built; {HOW}"
    (tmp_path / "kernels.0123456789abcdee.so").touch()
    assert kernels._why_not_loaded() == f"they were built from other sources; {HOW}"
    library.write_bytes(b"no library")
    assert kernels._why_not_loaded().startswith(f"{library}: ")


@pytest.mark.skipif(not IS_X86, reason="other processors have all that the kernels need")
def test_a_processor_without_avx2_loads_no_library(monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    assert "no AVX2" in kernels._why_not_loaded()


@pytest.fixture
def loadable(monkeypatch) -> kernels.Kernels:
    """Kernels without trials, of a library that can be loaded."""
    monkeypatch.setattr(kernels, "_why_not_loaded", lambda: "")
    return kernels.Kernels()


def test_kernels_that_disagree_with_torch_are_not_used_and_a_line_says_so(loadable, caplog):
    loadable.tried_by(lambda: True)
    assert loadable.usable(None)
    loadable.tried_by(lambda: False)
    assert not loadable.usable(None) and not loadable.usable_for(None, torch.zeros(1)) and not loadable.usable(False)
    with pytest.warns(UserWarning, match="torch computes .*: the kernels of .*test_native, as compiled here, do not"):
        assert not loadable.usable(True)
    (record,) = caplog.records
    assert "torch computes all" in record.getMessage() and record.getMessage().endswith(loadable.why_missing)


def test_threads_that_wait_for_a_trial_take_its_verdict(loadable):
    begun, others = threading.Event(), ThreadPoolExecutor(1)

    def disagree() -> bool:
        begun.set()
        time.sleep(0.3)  # the other thread waits meanwhile
        return False

    loadable.tried_by(disagree)
    first = others.submit(loadable.usable, None)
    assert begun.wait(10) and not loadable.usable(None) and not first.result(10)


def test_a_change_of_any_source_gives_the_library_another_name(monkeypatch):
    names, read = {library_path().name}, Path.read_bytes
    changed = [cpp_files()[0], cpp_files("*.h")[-1]]
    for source in changed:
        monkeypatch.setattr(Path, "read_bytes", lambda path, source=source: read(path) + b"\n" * (path == source))
        names.add(library_path().name)
    assert len(names) == 3
