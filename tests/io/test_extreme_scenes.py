"""Scenes of extreme numbers, in files that are as they should be: written and read back, or refused in one line."""

import struct

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import pointsplat_ns as ps
from making import same_bits
from pointsplat_ns.io.files import keep_usable
from pointsplat_ns.io.formats.splat import encode_splat
from pointsplat_ns.io.formats.spz import encode_spz

EXTREMES = [0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, 88.0, -104.0, 8388607.0, 1e20, -3.4e38, 3.4e38, np.inf, -np.inf, np.nan]
NUMBERS = st.one_of(st.sampled_from(EXTREMES), st.floats(-5, 5, width=32))
QUICK = settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@st.composite
def scenes(draw):
    """Scenes of up to five Gaussians of any degree, in which any number may be extreme."""
    n, degree = draw(st.integers(0, 5)), draw(st.integers(0, 3))
    tails = ((3,), (3,), (4,), (1,), (3,), ((degree + 1) ** 2 - 1, 3))
    tables = (draw(arrays.arrays(np.float32, (n, *tail), elements=NUMBERS.map(np.float32))) for tail in tails)
    return ps.Gaussians(*(torch.from_numpy(table) for table in tables))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog", ".splat"])
@given(scene=scenes())
@QUICK
def test_what_can_be_drawn_of_an_extreme_scene_is_written_and_read_back(tmp_path, suffix, scene):
    path = tmp_path / f"a{suffix}"
    usable = scene[scene.usable()]
    try:
        ps.save(scene, path)
    except ps.SceneError as error:  # SPZ reaches to 2^23 units
        assert suffix == ".spz" and float(usable.means.abs().max()) > 2**23 - 1 and "\n" not in str(error)
        return
    again = ps.load(path)
    assert len(again) == len(usable) and all(bool(value.isfinite().all()) for value in again.tensors())
    assert suffix != ".ply" or same_bits(again, keep_usable(scene, path))
    ps.save(again, path)  # what was read is written again
    assert len(ps.load(path)) == len(again)


HEAD = struct.Struct("<4sIIBBBB")


@given(count=st.integers(0, 2**32 - 1), degree=st.integers(0, 255), bits=st.integers(0, 255), version=st.integers(2, 4))
@QUICK
def test_headers_of_spz_that_do_not_fit_what_follows_are_refused_or_read_as_far(tmp_path, count, degree, bits, version):
    data = bytearray(encode_spz(ps.example_room()[:3], version=4))
    data[: HEAD.size] = HEAD.pack(b"NGSP", version, count, degree, bits, 0, data[15])
    (tmp_path / "a.spz").write_bytes(data)
    try:
        scene = ps.load(tmp_path / "a.spz")
    except ps.SceneError as error:
        assert "\n" not in str(error)
    else:
        assert len(scene) == count == 3 and degree == 1


@given(rows=st.lists(arrays.arrays(np.uint32, 8, elements=st.integers(0, 2**32 - 1)), max_size=6))
@QUICK
def test_any_bits_in_rows_of_splat_are_read(tmp_path, rows):
    (tmp_path / "a.splat").write_bytes(b"".join(row.tobytes() for row in rows))
    scene = ps.load(tmp_path / "a.splat")
    assert len(scene) <= len(rows) and bool(scene.usable().all())
    assert len(encode_splat(scene)) == 32 * len(scene)
