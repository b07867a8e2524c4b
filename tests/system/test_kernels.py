"""Kernels, which an installation builds where there is a compiler; cores and threads."""

import ctypes
import importlib
import math
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system import kernels
from pointsplat_ns.system.cores import cores, cpu_quota
from pointsplat_ns.system.kernels import (
    DOUBLE_POINTER,
    FLOAT_POINTER,
    FUNCTIONS,
    INT64_POINTER,
    KERNELS,
    Function,
    Kernels,
    Pointer,
    Struct,
)
from pointsplat_ns.system.native import INCLUDE, IS_X86, cpp_files, library_path
from pointsplat_ns.system.threads import fixed_threads

COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")


CALLERS = (
    "metrics.structural_similarity",
    "pipeline.optimiser",
    "pruning.merging.covariance",
    "pruning.merging.pair_cost",
    "pruning.merging.regrouping",
    "rendering.compiled.blending_kernels",
    "rendering.compiled.tile_kernels",
    "rendering.projection",
    "rendering.spherical_harmonics",
    "rendering.whole_pictures",
)
"""Modules that declare functions of C++ files."""

for name in CALLERS:
    importlib.import_module(f"pointsplat_ns.{name}")

CPP_NAMES: dict[object, str] = {
    None: "void",
    ctypes.c_int: "int",
    ctypes.c_int32: "int32_t",
    ctypes.c_int64: "int64_t",
    ctypes.c_float: "float",
    ctypes.c_double: "double",
    torch.float32: "float*",
    torch.float64: "double*",
    torch.int32: "int32_t*",
    torch.int64: "int64_t*",
}

SAME = """
#include <cstddef>
#include <cstdint>
#include <type_traits>
template <class T> struct plain { using type = std::remove_all_extents_t<T>; };
template <class T> struct plain<const T*> { using type = T*; };
template <class R, class... A> struct plain<R(A...)> { using type = R(typename plain<A>::type...); };
template <class T, class Expected> constexpr bool same = std::is_same_v<typename plain<T>::type, Expected>;
template <class T> constexpr bool points_to_struct =
    std::is_pointer_v<T> && std::is_class_v<std::remove_pointer_t<T>>;
"""
"""Compares types but for ``const``, and arrays by their numbers."""


def cpp_name(kind: object) -> str:
    """The C++ type of a declared one; of a struct its name, of an array its numbers' type."""
    if isinstance(kind, Pointer):
        return CPP_NAMES[kind.dtype]
    if isinstance(kind, type) and issubclass(kind, Struct):
        return kind.__name__.removesuffix("Struct")
    return CPP_NAMES[getattr(kind, "_type_", kind) if is_array(kind) else kind]


def is_array(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, ctypes.Array)


def structs_in(kinds: Iterable[object]) -> dict[str, type[Struct]]:
    """The structs among some types and their members, by their C++ names."""
    found: dict[str, type[Struct]] = {}
    for kind in kinds:
        if isinstance(kind, type) and issubclass(kind, Struct):
            found |= structs_in(kind.members.values()) | {cpp_name(kind): kind}
    return found


def source_of(function: str) -> Path:
    [source] = [path for path in cpp_files() if f" {function}(" in path.read_text("utf-8")]
    return source


def claims(function: Function) -> list[str]:
    """What a compiler has to find true if a function and its structs are declared right."""
    arguments = [
        f"{cpp_name(kind)}*" if cpp_name(kind) in structs_in([kind]) else cpp_name(kind)
        for kind in function.arguments
    ]
    expected = f"{cpp_name(function.result)}({', '.join(arguments)})"
    lines = [f"same<decltype({function.name}), {expected}>"]
    for name, struct in structs_in(function.arguments).items():
        lines.append(f"sizeof({name}) == {ctypes.sizeof(struct)}")
        for member, kind in struct.members.items():
            place = getattr(struct, member)
            declared = f"decltype({name}::{member})"
            lines += [
                f"offsetof({name}, {member}) == {place.offset}",
                f"sizeof({declared}) == {place.size}",
                f"points_to_struct<{declared}>"
                if isinstance(kind, Pointer) and kind.dtype is None
                else f"same<{declared}, {cpp_name(kind)}>",
            ]
    return lines


def compiles(source: Path, lines: list[str], folder: Path) -> bool:
    """Whether a compiler finds claims about a C++ file true."""
    check = folder / "check.cpp"
    asserted = [f"static_assert({line});" for line in lines]
    check.write_text("\n".join([SAME, f'#include "{source}"', *asserted, ""]), "utf-8")
    command = [COMPILER, "-std=c++17", "-fsyntax-only", f"-I{INCLUDE}", str(check)]
    return subprocess.run(command, capture_output=True).returncode == 0


@needs_compiler
@pytest.mark.parametrize("source", cpp_files(), ids=lambda source: source.stem)
def test_functions_and_structs_are_declared_as_the_compiler_reads_them(source, tmp_path):
    functions = [f for f in FUNCTIONS.values() if source_of(f.name) == source]
    assert functions
    assert compiles(source, [line for f in functions for line in claims(f)], tmp_path)


def test_every_function_of_the_library_is_declared():
    texts = [path.read_text("utf-8") for path in cpp_files()]
    defined = {
        name for text in texts for name in re.findall(r"^\w+ (pointsplat_\w+)\(", text, re.M)
    }
    assert defined == set(FUNCTIONS)


@needs_compiler
@pytest.mark.parametrize(
    "wrong",
    [
        Function("pointsplat_by_depth", DOUBLE_POINTER, ctypes.c_int64, INT64_POINTER),
        Function("pointsplat_by_depth", FLOAT_POINTER, ctypes.c_int32, INT64_POINTER),
        Function("pointsplat_by_depth", FLOAT_POINTER, ctypes.c_int64),
        Function(
            "pointsplat_by_depth", FLOAT_POINTER, ctypes.c_int64, INT64_POINTER, result=ctypes.c_int
        ),
    ],
    ids=["pointer", "width", "count", "result"],
)
def test_the_compiler_notices_a_wrong_declaration(wrong, tmp_path):
    assert not compiles(source_of(wrong.name), claims(wrong), tmp_path)


@pytest.fixture(autouse=True, scope="module")
def right_declarations():
    """Those of the package, in place of the wrong ones that this module makes."""
    from pointsplat_ns.rendering.compiled.tile_kernels import by_depth_kernel

    FUNCTIONS[by_depth_kernel.name] = by_depth_kernel


@needs_compiler
def test_a_call_with_other_arguments_than_declared_is_refused():
    call = FUNCTIONS["pointsplat_by_depth"]
    order = torch.empty(3, dtype=torch.int64)
    call(torch.tensor([3.0, 1.0, 2.0]), 3, order)
    assert order.tolist() == [1, 2, 0]
    with pytest.raises(TypeError, match="2 arguments; expected 3"):
        call(torch.zeros(3), 3)
    with pytest.raises(TypeError, match="4 arguments; expected 3"):
        call(torch.zeros(3), 3, order, None)
    with pytest.raises(ctypes.ArgumentError, match="expected torch.float32"):
        call(torch.zeros(3, dtype=torch.float64), 3, order)
    with pytest.raises(ctypes.ArgumentError, match="contiguous"):
        call(torch.zeros(3, 2)[:, 0], 3, order)
    with pytest.raises(ctypes.ArgumentError):
        call(torch.zeros(3), 3.5, order)


def test_a_struct_takes_its_own_members_and_types_alone():
    struct = {
        cpp: kind for f in FUNCTIONS.values() for cpp, kind in structs_in(f.arguments).items()
    }
    shapes = struct["Shapes"]
    with pytest.raises(AttributeError, match="ShapesStruct has no member scales"):
        shapes(scales=torch.zeros(1, 3))
    with pytest.raises(TypeError, match="expected torch.float32"):
        shapes(log_scales=torch.zeros(1, 3).double())
    with pytest.raises(TypeError, match="ChoiceStruct; expected ShapesStruct"):
        shapes.from_param(struct["Choice"]())


def test_a_library_that_is_missing_old_or_damaged_is_not_loaded(tmp_path):
    how = "installing builds them if there is a C++ compiler (in a clone: pip install -e .)"
    library = tmp_path / "kernels.0123456789abcdef.so"
    assert Kernels(library).why_missing == f"not built; {how}"
    (tmp_path / "kernels.0123456789abcdee.so").touch()
    assert Kernels(library).why_missing == f"built from other sources; {how}"
    clone = tmp_path / "clone" / "pointsplat_ns" / "system" / library.name
    clone.parent.mkdir(parents=True)
    (tmp_path / "clone" / "setup.py").touch()
    why = Kernels(clone).why_missing
    assert why.startswith("not built") and f"{tmp_path / 'clone'}: python setup.py build_ext" in why
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
