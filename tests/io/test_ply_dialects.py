"""PLYs of 3DGS as CloudCompare and Mip-Splatting write them."""

import math

import numpy as np
import pytest
import torch
from plys import columns_of, write_columns

import pointsplat_ns as ps
from making import normal_scene, same_bits
from pointsplat_ns.io.discovery import find_scenes
from pointsplat_ns.io.ply import PlyRows
from pointsplat_ns.io.ply_dialects import fuse_filter


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("prefix", ["scalar_", "scal_", "scalar_scal_"])
def test_names_with_prefixes_of_cloudcompare_are_read_to_the_bit(tmp_path, prefix, text, caplog):
    scene = normal_scene(6, 2)
    plain = {"x", "y", "z", "nx", "ny", "nz"}
    columns = {name if name in plain else prefix + name: array for name, array in columns_of(scene).items()}
    colors = {name: np.arange(6, dtype=np.uint8) for name in ("red", "green", "blue")}
    path = write_columns(tmp_path / "a.ply", {**columns, **colors, "scalar_Original_cloud_index": columns["x"]}, text)
    assert same_bits(ps.load(path), scene)
    assert "not read: the vertex properties red, green, blue, scalar_Original_cloud_index" in caplog.text
    assert [*find_scenes(tmp_path).values()] == [path]


def test_a_name_that_is_there_with_and_without_a_prefix_is_read_without(tmp_path):
    scene = normal_scene(4, 0)
    columns = {"scalar_opacity": np.zeros(4, np.float32), **columns_of(scene), "scal_rot_0": np.zeros(4, np.float32)}
    assert same_bits(ps.load(write_columns(tmp_path / "a.ply", columns)), scene)


def test_the_3d_filter_of_mip_splatting_is_fused_as_its_exporter_does(tmp_path, caplog):
    """Against the exporter's own formulas, in float64: sizes sqrt(s^2 + f^2), opacities times sqrt(det / det)."""
    scene = normal_scene(50, 1)
    sizes = np.abs(np.random.default_rng(3).normal(size=50)).astype(np.float32)
    path = write_columns(tmp_path / "a.ply", {**columns_of(scene), "filter_3D": sizes})
    found = ps.load(path)
    square = np.exp(scene.scales.double().numpy()) ** 2
    after = square + sizes[:, None].astype(np.float64) ** 2
    ratio = np.sqrt(square.prod(axis=1) / after.prod(axis=1))
    opacity = scene.alphas.double().numpy() * ratio
    assert np.allclose(found.scales.numpy(), np.log(np.sqrt(after)), rtol=0, atol=1e-6)
    assert np.allclose(found.opacities[:, 0].numpy(), np.log(opacity / (1 - opacity)), rtol=1e-5, atol=1e-5)
    assert found.antialiased  # as it was trained
    assert torch.equal(found.means, scene.means) and torch.equal(found.quats, scene.quats)
    assert "filter_3D" not in caplog.text  # it is not left out
    rows = PlyRows.open(path)
    assert same_bits(rows.read(0, 50), found) and same_bits(rows.pick([7, 3]), found[[7, 3]])


def test_a_3d_filter_keeps_its_digits_at_the_ends_of_float32():
    """Each case against the same formula with 50 digits, from logarithms."""
    mpmath = pytest.importorskip("mpmath")
    mpmath.mp.dps = 50
    cases = [
        (s, o, f) for s in (-80.0, -12.0, 0.0, 40.0) for o in (-80.0, -5.0, 0.0, 17.0, 80.0) for f in (1e-30, 1e-3, 1e9)
    ]
    cases += [(-3.0, 80.0, 0.0), (-3.0, -80.0, 0.0)]
    for s, o, f in cases:
        scales = np.array([[s, s + 1, s - 2]], np.float32)
        wide, logits = fuse_filter(scales, np.array([[o]], np.float32), np.array([[f]], np.float32))
        square = [mpmath.exp(2 * mpmath.mpf(float(value))) for value in scales[0]]
        after = [value + mpmath.mpf(float(np.float32(f))) ** 2 for value in square]
        wanted = [float(mpmath.log(value) / 2) for value in after]
        opacity = 1 / (1 + mpmath.exp(-o))
        for one, other in zip(square, after, strict=True):
            opacity *= mpmath.sqrt(one / other)
        logit = float(mpmath.log(opacity) - mpmath.log(1 - opacity))
        assert np.allclose(wide[0], wanted, rtol=2e-7, atol=2e-7), (s, o, f)
        # 1e-14: in float64 an opacity that is 1 but for less than 1e-16 has a ratio of 1
        assert abs(float(logits[0, 0]) - logit) <= 2e-6 * max(1, abs(logit)) or 1 - opacity < 1e-14, (s, o, f, logit)


def test_a_3d_filter_on_values_that_are_no_numbers_gives_none():
    inf = math.inf
    scales = np.array([[-inf, 0, 0], [-inf, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]], np.float32)
    logits = np.array([[1], [1], [inf], [-inf], [1]], np.float32)
    sizes = np.array([[0], [1], [0], [1], [np.nan]], np.float32)
    wide, found = fuse_filter(scales, logits, sizes)
    assert wide[0].tolist() == [-inf, 0, 0] and found[0] == 1  # a flat axis stays flat without a filter
    assert wide[1, 0] == 0 and found[1] == -inf  # nothing of it is left
    assert found[2] == inf and found[3] == -inf and np.isnan(wide[4]).all()
