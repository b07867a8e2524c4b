"""Python calls C++ by what the C++ file declares."""

import ctypes
import re
import shutil
import subprocess

import pytest

from pointsplat_ns.system.kernels import structs_of
from pointsplat_ns.system.native import INCLUDE, cpp_files

COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)


@pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("source", cpp_files(), ids=lambda source: source.stem)
def test_structs_are_laid_out_as_the_compiler_lays_them_out(source, tmp_path):
    text = source.read_text("utf-8")
    included = [source.with_name(name) for name in re.findall(r'^#include "(.+)"$', text, re.M)]
    structs = structs_of("".join(path.read_text("utf-8") for path in (*included, source) if path.is_file()))
    assert structs
    lines = ["#include <cstddef>", f'#include "{source}"']
    for name, struct in structs.items():
        lines.append(f"static_assert(sizeof({name}) == {ctypes.sizeof(struct)});")
        places = {field: getattr(struct, field).offset for field, _ in struct._fields_}
        lines += [f"static_assert(offsetof({name}, {field}) == {place});" for field, place in places.items()]
    check = tmp_path / "check.cpp"
    check.write_text("\n".join(lines) + "\n", "utf-8")
    subprocess.run([COMPILER, "-std=c++17", "-fsyntax-only", f"-I{INCLUDE}", str(check)], check=True)
