"""C++ is built once, into a folder that only its user can write to."""

import ctypes
import re
import shutil
from pathlib import Path

import pytest

from pointsplat_ns.system import kernels
from pointsplat_ns.system.kernels import NativeCodeError

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
        return kernels.load_native.__wrapped__(source)

    load.cache = cache
    return load


def test_what_was_built_is_loaded_and_a_changed_source_is_built_anew(build, monkeypatch):
    assert build(TWO).answer() == 2
    (library,) = build.cache.iterdir()
    assert re.fullmatch(r"some-[0-9a-f]{20}\.so", library.name) and build.cache.stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(kernels, "_build", lambda *args: pytest.fail("built again"))
    assert build(TWO).answer() == 2
    monkeypatch.undo()
    monkeypatch.setenv("POINTSPLAT_CACHE", str(build.cache))
    assert build(TWO.replace("2", "3")).answer() == 3 and len(list(build.cache.iterdir())) == 2


def test_a_changed_header_beside_the_source_is_built_anew(build, tmp_path):
    header = tmp_path / "some.h"
    for number in (2, 3):
        header.write_text(f"constexpr int NUMBER = {number};\n")
        assert build('#include "some.h"\nextern "C" int answer() { return NUMBER; }\n').answer() == number


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
