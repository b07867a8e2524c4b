"""Compiled kernels that do not do what torch does are found out when they are first asked for."""

import functools
import hashlib
import shutil
import subprocess

import pytest

from pointsplat_ns import merging, metrics, rasterizer  # noqa: F401  (their trials)
from pointsplat_ns.system.kernels import KERNELS
from pointsplat_ns.system.native import FLAGS, INCLUDE, cpp_files

COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Gives the object file of a C++ file, and keeps it."""
    folder = tmp_path_factory.mktemp("objects")

    @functools.cache
    def compile_file(source):
        target = folder / f"{hashlib.sha256(str(source).encode()).hexdigest()}.o"
        subprocess.run([COMPILER, *FLAGS, "-c", "-fPIC", f"-I{INCLUDE}", "-o", target, source], check=True)
        return target

    return compile_file


@needs_compiler
@pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)
@pytest.mark.parametrize(
    ("right", "wrong", "times"),
    [
        pytest.param("behind[row] += alpha * change", "behind[row] += change", 1, id="a gradient"),
        pytest.param("-3.5f, -2.5f", "-2.5f, -3.5f", 1, id="two pixels"),
        pytest.param("alpha * t : ZERO;", "alpha : ZERO;", 3, id="a weight"),
        pytest.param(
            "grad_det0 += grad_ratio / s.det * (s.blur / s.det)", "grad_det0 += grad_ratio / s.det", 1,
            id="a projected gradient",
        ),
        pytest.param(
            "if (!flat.drawn[lane]) continue;", "if (lane == 3) continue;", 2, id="who is seen"
        ),
        pytest.param("r * v + sign", "r * v - sign", 1, id="which tiles of a picture"),
        pytest.param("color < 0.0f ? 0.0f : color;", "color;", 1, id="a picture's colour"),
        pytest.param("[drawn++] = static_cast<int64_t>(bits) << 32", "[drawn++] = 0", 1, id="what is in front"),
        pytest.param("+ 2.0f * (h5 * xz) -", "- 2.0f * (h5 * xz) -", 1, id="a colour's gradient"),
        pytest.param("grad_rest + task.ids[row] * task.rest_row", "grad_rest", 1, id="a part's gradient"),
        pytest.param("x + s[5] * dy + sign", "x - s[5] * dy + sign", 1, id="which tiles"),
        pytest.param("tile_to(y + half_y,", "tile_to(y - half_y,", 1, id="a box"),
        pytest.param("transmittance_min ? alpha * t", "transmittance_min ? t", 1, id="visible pixels"),
        pytest.param("2 * (x * y - w * z)", "2 * (x * y)", 1, id="a rotation"),
        pytest.param("ik = wi * ii + wj * ij", "ik = wi * ii", 1, id="a cost"),
        pytest.param("j > i ? (cost", "j < i ? (cost", 1, id="a pair"),
        pytest.param("(cov[1] + x * y)", "(cov[1] - x * y)", 1, id="a fit"),
        pytest.param("- square + C2;", "+ C2;", 1, id="a variance"),
        pytest.param("column - REACH * task.step,", "column,", 1, id="a border's gradient"),
        pytest.param(
            "y - REACH) * windows + column;", "y - REACH) * windows;", 1, id="a block's gradient"
        ),
    ],
)  # fmt: skip
def test_kernels_that_differ_from_torch_are_found_out(right, wrong, times, compiled, tmp_path, monkeypatch):
    texts = {path: path.read_text("utf-8") for path in (*cpp_files(), *cpp_files("*.h"))}
    assert sum(text.count(right) for text in texts.values()) == times
    changed = {path.name for path, text in texts.items() if right in text}
    objects = []
    for path, text in texts.items():
        (tmp_path / path.name).write_text(text.replace(right, wrong), "utf-8")
    for path in cpp_files():
        spoilt = path.name in changed or any(f'#include "{name}"' in texts[path] for name in changed)
        objects.append(compiled(tmp_path / path.name if spoilt else path))
    subprocess.run([COMPILER, "-shared", "-o", tmp_path / "spoiled.so", *objects], check=True)
    assert all(agree() for agree in KERNELS.trials)
    monkeypatch.setattr(KERNELS, "library", KERNELS.loaded(tmp_path / "spoiled.so"))
    assert not all(agree() for agree in KERNELS.trials)


@needs_compiler
def test_where_there_is_a_compiler_kernels_do_as_torch_does():
    """Tests of kernels skip where none can be used; this one tells of a library that is missing or old."""
    assert KERNELS.why_missing == ""
