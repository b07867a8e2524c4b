"""C++ is built once, into a folder that only its user can write to."""

import ctypes
import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pointsplat_ns.system import native_libraries
from pointsplat_ns.system.native_libraries import NativeCodeError

TWO = 'extern "C" int answer() { return 2; }\n'

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="there is no C++ compiler"
)


@pytest.fixture()
def build(tmp_path, monkeypatch):
    """Builds and loads a text, without what this process remembers."""
    cache = tmp_path / "cache"
    monkeypatch.setenv("POINTSPLAT_CACHE", str(cache))

    def load(text: str) -> ctypes.CDLL:
        source = tmp_path / "some.cpp"
        source.write_text(text, "utf-8")
        return native_libraries.load_native.__wrapped__(source)

    load.cache = cache
    return load


def test_what_was_built_is_loaded_and_a_changed_source_is_built_anew(build, monkeypatch):
    assert build(TWO).answer() == 2
    (library,) = build.cache.iterdir()
    assert (
        re.fullmatch(r"some-[0-9a-f]{20}-[0-9a-f]{64}\.so", library.name)
        and build.cache.stat().st_mode & 0o777 == 0o700
    )
    monkeypatch.setattr(native_libraries, "_build", lambda *args: pytest.fail("built again"))
    assert build(TWO).answer() == 2
    monkeypatch.undo()
    monkeypatch.setenv("POINTSPLAT_CACHE", str(build.cache))
    assert build(TWO.replace("2", "3")).answer() == 3 and len(list(build.cache.iterdir())) == 2


def test_a_changed_header_beside_the_source_is_built_anew(build, tmp_path):
    header = tmp_path / "some.h"
    for number in (2, 3):
        header.write_text(f"constexpr int NUMBER = {number};\n")
        assert build('#include "some.h"\nextern "C" int answer() { return NUMBER; }\n').answer() == number


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:4096], lambda data: data[:-1] + b"\1"])
def test_a_damaged_library_is_built_again_once_and_said(damage, build, caplog):
    """glibc ends the program when it loads one that was cut."""
    build(TWO)
    (library,) = build.cache.iterdir()
    whole = library.read_bytes()
    library.unlink()  # the one that is loaded stays as it is
    library.write_bytes(damage(whole))
    assert build(TWO).answer() == 2 and [record.getMessage() for record in caplog.records] == [
        f"{library}: damaged, so it is built again"
    ]
    (again,) = build.cache.iterdir()
    assert hashlib.sha256(again.read_bytes()).hexdigest() in again.name
    build(TWO)
    assert len(caplog.records) == 1


def test_unfinished_files_of_killed_processes_are_removed(build):
    build.cache.mkdir(mode=0o700)
    old, new = build.cache / ".old.part", build.cache / ".new.part"
    for path in (old, new):
        path.touch()
    os.utime(old, (0, 0))
    build(TWO)
    assert not old.exists() and new.exists()  # another process may be at work on it


def test_a_folder_that_others_can_write_to_is_not_loaded_from(build, tmp_path):
    build.cache.mkdir()
    build.cache.chmod(0o777)
    assert build(TWO).answer() == 2 and not list(build.cache.iterdir())


@pytest.mark.parametrize("text", ["int answer( {\n", "#error no\n"])
def test_what_does_not_compile_is_said_in_a_line_and_leaves_nothing(build, text):
    with pytest.raises(NativeCodeError, match="error") as caught:
        build(text)
    assert "\n" not in str(caught.value) and not list(build.cache.iterdir())


def test_no_compiler_and_a_broken_one_are_said_in_a_line(build, monkeypatch, tmp_path):
    monkeypatch.setenv("CXX", "/nowhere/c++")
    with pytest.raises(NativeCodeError, match="^CXX is /nowhere/c\\+\\+, which is not there$"):
        build(TWO)
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NativeCodeError, match="^there is no C\\+\\+ compiler$"):
        build(TWO)
    broken = Path(tmp_path / "c++")
    broken.write_text("no program", "utf-8")
    broken.chmod(0o755)
    with pytest.raises(NativeCodeError, match="c\\+\\+: "):
        build(TWO)


COMPILER = """#!/bin/sh
case "$*" in *{source}*) echo "{source}: internal error" >&2; exit 1;; esac
exec {compiler} "$@"
"""

WORK = """
import sys
import pointsplat_ns as ps
scene = ps.example_room()[::20]
ps.save(ps.prune(scene, 0.3), sys.argv[1])
ps.render(scene, ps.sample_views(scene, 2, 64, 48)).numpy().tofile(sys.argv[1] + ".raw")
"""


def worked(folder: Path, name: str, **environment: str) -> tuple[list[bytes], str]:
    """What a process writes that prunes and renders, and what it says."""
    output = folder / f"{name}.ply"
    done = subprocess.run(
        [sys.executable, "-c", WORK, str(output)], env={**os.environ, **environment}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return [output.read_bytes(), Path(f"{output}.raw").read_bytes()], done.stderr


def test_where_one_library_fails_torch_computes_all_and_a_line_says_so(tmp_path):
    """The library of pictures, which calls that of blending; the files are those of a machine without a compiler."""
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))))
    bare, said = worked(tmp_path, "bare", PATH="", POINTSPLAT_CACHE=str(tmp_path / "bare"))
    assert said == ""
    for source in ("pictures.cpp", "blending.cpp"):
        broken = tmp_path / f"without-{source}"
        broken.write_text(COMPILER.format(source=source, compiler=compiler))
        broken.chmod(0o755)
        found, said = worked(tmp_path, source, CXX=str(broken), POINTSPLAT_CACHE=str(tmp_path / source / "cache"))
        assert found == bare and len(said.splitlines()) == 1
        assert said.startswith("compiled code is not used, torch computes all, slower and rounded otherwise: ")
        assert f"{source}: internal error" in said
