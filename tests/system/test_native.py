"""Kernels are built by an installation where there is a compiler; where they are not, torch computes everything."""

import shutil
from pathlib import Path

import pytest
import torch

from pointsplat_ns.system.kernels import KERNELS, Kernels
from pointsplat_ns.system.native import IS_X86, cpp_files, library_path

HOW = "where there is a C++ compiler, installing builds them (in a clone: pip install -e .)"


def test_a_library_that_is_missing_old_or_damaged_is_not_loaded(tmp_path):
    library = tmp_path / "kernels.0123456789abcdef.so"
    assert Kernels(library).why_missing == f"they were not built; {HOW}"
    (tmp_path / "kernels.0123456789abcdee.so").touch()
    assert Kernels(library).why_missing == f"they were built from other sources; {HOW}"
    library.write_bytes(b"no library")
    assert Kernels(library).why_missing.startswith(f"{library}: ")


@pytest.mark.skipif(not IS_X86, reason="other processors have all that the kernels need")
def test_a_processor_without_avx2_loads_no_library(monkeypatch):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    assert "no AVX2" in Kernels(library_path()).why_missing


def test_a_change_of_any_source_gives_the_library_another_name(monkeypatch):
    names, read = {library_path().name}, Path.read_bytes
    changed = [cpp_files()[0], cpp_files("*.h")[-1]]
    for source in changed:
        monkeypatch.setattr(Path, "read_bytes", lambda path, source=source: read(path) + b"\n" * (path == source))
        names.add(library_path().name)
    assert len(names) == 3


@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="there is no C++ compiler")
def test_where_there_is_a_compiler_kernels_are_used():
    """Tests of kernels skip where none can be used; this one tells of a library that is missing or old."""
    assert KERNELS.why_missing == ""
