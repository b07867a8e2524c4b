"""Compiled kernels that do not do what torch does are found out when they are first asked for."""

import functools
import hashlib
import shutil
import subprocess

import pytest

from pointsplat_ns.merging import covariance, matching, pair_cost, regrouping, replacement
from pointsplat_ns.metrics import structural_similarity
from pointsplat_ns.rasterizer import compiled as rasterizer
from pointsplat_ns.system.native import FLAGS, INCLUDE

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
@pytest.mark.skipif(bool(rasterizer.KERNELS.why_missing), reason=rasterizer.KERNELS.why_missing)
@pytest.mark.parametrize(
    ("module", "right", "wrong", "times"),
    [
        pytest.param(rasterizer, "behind[row] += alpha * change", "behind[row] += change", 1, id="a gradient"),
        pytest.param(rasterizer, "-3.5f, -2.5f", "-2.5f, -3.5f", 1, id="two pixels"),
        pytest.param(rasterizer, "alpha * t : ZERO;", "alpha : ZERO;", 3, id="a weight"),
        pytest.param(
            rasterizer, "grad_det0 += grad_ratio / s.det * (s.blur / s.det)", "grad_det0 += grad_ratio / s.det", 1,
            id="a projected gradient",
        ),
        pytest.param(
            rasterizer, "if (!flat.drawn[lane]) continue;", "if (lane == 3) continue;", 2, id="who is seen"
        ),
        pytest.param(rasterizer, "r * v + sign", "r * v - sign", 1, id="which tiles of a picture"),
        pytest.param(rasterizer, "color < 0.0f ? 0.0f : color;", "color;", 1, id="a picture's colour"),
        pytest.param(rasterizer, "static_cast<int64_t>(bits) << 32", "int64_t(0)", 1, id="what is in front"),
        pytest.param(rasterizer, "+ 2.0f * (h5 * xz) -", "- 2.0f * (h5 * xz) -", 1, id="a colour's gradient"),
        pytest.param(rasterizer, "grad_rest + task.ids[row] * task.rest_row", "grad_rest", 1, id="a part's gradient"),
        pytest.param(rasterizer, "x + s[5] * dy + sign", "x - s[5] * dy + sign", 1, id="which tiles"),
        pytest.param(rasterizer, "tile_to(y + half_y,", "tile_to(y - half_y,", 1, id="a box"),
        pytest.param(rasterizer, "transmittance_min ? alpha * t", "transmittance_min ? t", 1, id="visible pixels"),
        pytest.param(covariance, "2 * (x * y - w * z)", "2 * (x * y)", 1, id="a rotation"),
        pytest.param(pair_cost, "ik = wi * ii + wj * ij", "ik = wi * ii", 1, id="a cost"),
        pytest.param(matching, "j > i ? (cost", "j < i ? (cost", 1, id="a pair"),
        pytest.param(replacement, "wj * sj.xy + both * (apart.x * apart.y)", "wj * sj.xy", 1, id="a covariance"),
        pytest.param(regrouping, "(cov[1] + x * y)", "(cov[1] - x * y)", 1, id="a fit"),
        pytest.param(structural_similarity, "- square + C2;", "+ C2;", 1, id="a variance"),
        pytest.param(structural_similarity, "column - REACH * task.step,", "column,", 1, id="a border's gradient"),
        pytest.param(
            structural_similarity, "y - REACH) * windows + column;", "y - REACH) * windows;", 1, id="a block's gradient"
        ),
    ],
)  # fmt: skip
def test_kernels_that_differ_from_torch_are_found_out(module, right, wrong, times, compiled, tmp_path, monkeypatch):
    kernels = module.KERNELS
    folder = kernels.files[0].parent
    texts = {path.name: path.read_text("utf-8") for path in (*kernels.files, *folder.glob("*.h"))}
    assert sum(text.count(right) for text in texts.values()) == times
    changed = {name for name, text in texts.items() if right in text}
    objects = []
    for name, text in texts.items():
        (tmp_path / name).write_text(text.replace(right, wrong), "utf-8")
    for path in kernels.files:
        spoilt = path.name in changed or any(f'#include "{name}"' in texts[path.name] for name in changed)
        objects.append(compiled(tmp_path / path.name if spoilt else path))
    subprocess.run([COMPILER, "-shared", "-o", tmp_path / "spoiled.so", *objects], check=True)
    assert kernels.agrees()
    monkeypatch.setattr(kernels, "library", kernels.loaded(tmp_path / "spoiled.so"))
    assert not kernels.agrees()


@needs_compiler
def test_where_there_is_a_compiler_kernels_do_as_torch_does():
    """Tests of kernels skip where none can be used; this one tells of a library that is missing or old."""
    assert rasterizer.KERNELS.why_missing == ""
