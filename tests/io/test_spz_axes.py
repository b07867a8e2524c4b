"""SPZ files of version 4 with extensions: the axes that one names are turned to right, up, back; others are skipped."""

from __future__ import annotations

import struct

import pytest
import torch

import pointsplat_ns as ps
from making import cloud, same_bits
from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.formats.spz import encode_spz, read_spz

AXES = 0xADBE0003
TO_RUB = {  # number in the file, and what a point (x, y, z) of these axes is in right, up, back
    "LDB": (1, lambda x, y, z: (-x, -y, z)),
    "RUB": (4, lambda x, y, z: (x, y, z)),
    "RDF": (6, lambda x, y, z: (x, -y, -z)),
    "LUF": (7, lambda x, y, z: (-x, y, -z)),
    "LFD": (9, lambda x, y, z: (-x, -z, -y)),
    "RFU": (12, lambda x, y, z: (x, z, -y)),
    "RBU": (16, lambda x, y, z: (x, z, y)),
}


def with_records(path, *records, flags=2, table=None):
    """The bytes of an SPZ file of version 4 with extensions: pairs of a kind and its content."""
    data = path.read_bytes()
    block = b"".join(struct.pack("<II", kind, len(content)) + content for kind, content in records)
    table = 32 + len(block) if table is None else table
    return data[:14] + bytes([flags]) + data[15:16] + struct.pack("<I", table) + data[20:32] + block + data[32:]


@pytest.fixture()
def scene(tmp_path):
    """A scene that an SPZ file holds, with what is read of it."""
    (tmp_path / "a.spz").write_bytes(encode_spz(cloud(60, 3, 3), version=4))
    return read_spz(tmp_path / "a.spz")


@pytest.mark.parametrize("name", TO_RUB)
def test_a_scene_on_other_axes_is_turned_and_looks_the_same(tmp_path, scene, name):
    number, to_rub = TO_RUB[name]
    data = with_records(tmp_path / "a.spz", (0x12340001, b"others"), (AXES, struct.pack("<I", number)))
    (tmp_path / "b.spz").write_bytes(data)
    turned = read_spz(tmp_path / "b.spz")
    torch.testing.assert_close(turned.means, torch.stack(to_rub(*scene.means.T), dim=1), rtol=0, atol=1e-6)
    matrix = torch.stack(to_rub(*torch.eye(3, dtype=torch.float64)), dim=1).T  # columns are the file's axes
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 24], [0, 0, 1]], dtype=torch.float64)
    pictures = []
    for shown, turn in ((scene, torch.eye(3, dtype=torch.float64)), (turned, matrix.T)):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[2, 3] = turn, 6.0
        shown = shown.to(torch.float64)
        image, _, _ = ps.rasterization(
            shown.means, shown.quats, shown.stds, shown.alphas, shown.sh, viewmat[None], K[None], 48, 48, sh_degree=3
        )
        pictures.append(image)
    # A pixel at a threshold of alpha may fall on the other side of it by rounding: 1/255 of it then shows.
    assert (pictures[0] - pictures[1]).abs().max() < 5e-3 and (pictures[0] - pictures[1]).abs().mean() < 1e-5
    assert float(pictures[0].std()) > 0.02


def test_a_file_that_names_no_axes_keeps_its_own_and_says_what_is_not_read(tmp_path, scene, caplog):
    for content in (struct.pack("<I", 0), struct.pack("<I", 17), b"", b"12345"):
        (tmp_path / "b.spz").write_bytes(with_records(tmp_path / "a.spz", (AXES, content), (7, b"")))
        caplog.clear()
        assert same_bits(read_spz(tmp_path / "b.spz"), scene)
        assert "not read: 0xadbe0003, 0x7" in caplog.text


def test_extensions_that_lie_about_their_size_are_refused(tmp_path, scene):
    record = struct.pack("<II", AXES, 2**32 - 1) + b"1234"
    head = with_records(tmp_path / "a.spz")
    cut = head[:16] + struct.pack("<I", 32 + len(record)) + head[20:32] + record + head[32:]
    far = with_records(tmp_path / "a.spz", *[(1, b"")] * (1 << 17))
    odd = with_records(tmp_path / "a.spz", (1, b"12"))[:-1]
    short = head[:16] + struct.pack("<I", 35) + head[20:32] + b"123" + head[32:]
    for data, why in (
        (cut, "truncated"),
        (far, "bytes before the attributes"),
        (odd, "truncated"),
        (short, "truncated"),
    ):
        (tmp_path / "b.spz").write_bytes(data)
        with pytest.raises(SceneError, match=why):
            read_spz(tmp_path / "b.spz")
