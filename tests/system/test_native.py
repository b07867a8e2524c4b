"""Kernels are built by an installation where there is a compiler; where they are not, torch computes everything."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from making import REPOSITORY
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


DRAW = """
import warnings
import torch
from pointsplat_ns.rasterizer import rasterization
eyes = torch.eye(4)[None], torch.eye(3)[None]
scene = torch.tensor([[0.0, 0.0, 2.0]]), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3)
for compiled in (None, True):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        image, _, _ = rasterization(*scene, *eyes, 8, 8, compiled=compiled)
    print(round(float(image.max()), 3), *{str(each.message) for each in caught}, sep="|")
"""


def python(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a Python in a folder printed, with the package of that folder."""
    given = {**os.environ, "PYTHONPATH": str(folder), **environment}
    done = subprocess.run([sys.executable, *words], cwd=folder, env=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done


def test_a_clone_without_kernels_draws_by_torch_and_says_how_to_build_them(tmp_path):
    """Also where the compiler fails, and one whose sources have changed since."""
    pytest.importorskip("setuptools", minversion="77")
    shutil.copytree(
        REPOSITORY / "pointsplat_ns", tmp_path / "pointsplat_ns", ignore=shutil.ignore_patterns("*.so", "__pycache__")
    )
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, tmp_path / name)
    built = python(tmp_path, "setup.py", "build_ext", "--inplace", CC="false", CXX="false")
    assert 'building extension "pointsplat_ns.system.kernels" failed' in built.stderr
    folder = tmp_path / library_path().parent.relative_to(REPOSITORY)
    assert not list(folder.glob("*.so"))
    (folder / "kernels.0123456789abcdef.so").touch()  # of other sources
    done = python(tmp_path, "-c", DRAW)
    (said,) = done.stderr.splitlines()
    assert said.endswith(f"they were built from other sources; {HOW}")
    why = said.partition(": ")[2]
    assert done.stdout.splitlines() == ["0.635", f"0.635|torch computes what kernels were asked for: {why}"]


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
    assert kernels.KERNELS.why_missing == ""
