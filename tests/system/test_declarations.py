"""Python calls C++ by what the C++ file declares."""

import ctypes
import re
import shutil
import subprocess

import pytest
import torch

from pointsplat_ns.system.kernels import functions_of, structs_of
from pointsplat_ns.system.native import INCLUDE, cpp_files

SHARED = """
struct Hidden {
    bool not_shared;
};

extern "C" {

// A comment; with a semicolon.
struct Inner {
    int32_t number;  // four bytes, then padding
    double values[2][3];
};

struct Task {
    Inner inner;
    const float *a, *b;
    int64_t count;
};

int pointsplat_size() { return 3; }

void pointsplat_run(const Task* task, const int64_t* rows,
                    int64_t count) {
    if (task) return;
}

}  // extern "C"
"""
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


def test_what_is_shared_is_declared_with_its_types():
    structs = structs_of(SHARED)
    assert [*structs] == ["Inner", "Task"]
    assert structs["Inner"]._fields_ == [("number", ctypes.c_int32), ("values", ctypes.c_double * 6)]
    fields = [("inner", structs["Inner"]), ("a", ctypes.c_void_p), ("b", ctypes.c_void_p), ("count", ctypes.c_int64)]
    assert structs["Task"]._fields_ == fields and structs["Task"].pointers["a"].dtype == torch.float32
    functions = functions_of(SHARED, structs)
    assert functions["pointsplat_size"] == (ctypes.c_int, [])
    result, (task, rows, count) = functions["pointsplat_run"]
    assert result is None and task.dtype is None and rows.dtype == torch.int64 and count is ctypes.c_int64
