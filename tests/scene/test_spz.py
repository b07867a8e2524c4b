"""SPZ of every version: what is written comes back, and what other programs write is read."""

import base64
import gzip
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from foreign import encode_spz4
from refusing import fails

import pointsplat_ns as ps
from making import cloud, normal_scene, same_bits
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.pipeline.quality import Judge
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.scene.formats.gltf import content_with_spz
from pointsplat_ns.scene.formats.gltf_container import pack_glb
from pointsplat_ns.scene.formats.spz import decode_spz, encode_spz, version_of
from pointsplat_ns.scene.formats.spz_extensions import AXES

CASES = Path(__file__).parent / "cases"


def covariances(scene):
    turns = rotation_matrices(scene.quats.double())
    return turns @ torch.diag_embed(scene.stds.double() ** 2) @ turns.mT


def psnr_to(dense, scene):
    return Judge(dense, ViewProvider(dense)).psnr(scene)[0]


def record(kind, content):
    return struct.pack("<II", kind, len(content)) + content


def gzipped(version, flags, tail, scene):
    """A file of version 2 or 3 with other flags, and bytes after its attributes."""
    content = bytearray(gzip.decompress(encode_spz(scene, version=version)))
    content[14] |= flags
    return gzip.compress(bytes(content) + tail)


# Written


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize(("count", "degree"), [(0, 0), (0, 2), (1, 0), (300, 1), (200, 3)])
def test_every_version_comes_back_and_stays_the_same_when_written_again(
    tmp_path, version, count, degree
):
    scene = cloud(count, degree, degree).replace(antialiased=bool(count))
    path = tmp_path / "a.spz"
    ps.save(scene, path, spz_version=version)
    assert version_of(path) == version
    back = ps.load(path)
    assert (len(back), back.sh_degree, back.antialiased) == (count, degree, bool(count))
    if count:
        assert float((back.means - scene.means).abs().max()) <= 2.0**-13
        assert float((back.alphas - scene.alphas).abs().max()) <= 1 / 255
        assert float((back.scales - scene.scales.clamp(-10, 6)).abs().max()) <= 1 / 32 + 1e-6
        turns = [rotation_matrices(of.quats.double()) for of in (back, scene)]
        # x, y and z are stored in steps of 1/127 in version 2, where a small w has errors of 0.1
        assert float((turns[0] - turns[1]).abs().max()) < (0.25 if version == 2 else 0.008)
        assert float((turns[0] - turns[1]).abs().mean()) < (0.02 if version == 2 else 0.003)
    ps.save(back, tmp_path / "b.spz", spz_version=version)
    again = ps.load(tmp_path / "b.spz")
    for name, value in back.items():
        if name != "quats":
            assert torch.equal(dict(again.items())[name], value), name
    turns = [rotation_matrices(of.quats.double()) for of in (back, again)]
    # quaternions are read unnormalised in version 2, if x, y and z are too long
    torch.testing.assert_close(*turns, rtol=0, atol=0.03 if version == 2 else 0.003)


def test_versions_hold_the_same_but_for_the_quaternions_of_2():
    scene = cloud(500, 2, 1)
    two, three, four = (
        decode_spz(encode_spz(scene, version=version), Path("a")) for version in (2, 3, 4)
    )
    assert same_bits(three, four)
    assert same_bits(two.replace(quats=four.quats), four) and not same_bits(two, four)


def test_version_4_has_the_layout_of_the_library_and_declares_the_axes_of_a_ply():
    data = encode_spz(cloud(50, 1, 1))
    magic, version, count, degree, bits, flags, streams, start = struct.unpack_from(
        "<4sIIBBBBI", data
    )
    assert (magic, version, count, degree, bits) == (b"NGSP", 4, 50, 1, 12)
    assert (flags, streams, start, data[20:32]) == (2, 6, 44, bytes(12))
    assert struct.unpack_from("<III", data, 32) == (0xADBE0003, 4, 6)  # right, down, front
    table = np.frombuffer(data, "<u8", 12, start).reshape(6, 2)
    assert table[:, 1].tolist() == [450, 50, 150, 150, 200, 450]
    assert start + 6 * 16 + table[:, 0].sum() == len(data)


def test_old_versions_declare_nothing_as_old_readers_refuse_more_bytes():
    for version, quat_bytes in ((2, 3), (3, 4)):
        content = gzip.decompress(encode_spz(cloud(50, 1, 1), version=version))
        assert content[14] == 0 and len(content) == 16 + 50 * (16 + quat_bytes + 9)


@pytest.mark.parametrize("version", [1, 5, "4", True])
def test_other_versions_are_not_written(tmp_path, version):
    with pytest.raises(ps.PointSplatError, match="is not written; expected 4, 3 or 2"):
        ps.save(cloud(3), tmp_path / "a.spz", spz_version=version)
    assert not [*tmp_path.iterdir()]


def test_every_version_of_a_room_looks_the_same(tmp_path):
    room = ps.example_room()[::20]
    found = {}
    for version in (2, 3, 4):
        path = tmp_path / f"{version}.spz"
        ps.save(room, path, spz_version=version)
        found[version] = psnr_to(room, ps.load(path))
    assert found[2] > 39 and found[3] == found[4] > 43


# Axes


def test_every_declared_system_is_turned_to_that_of_a_ply_as_the_library_does():
    """Written by the format's library (npm: @adobe/spz 0.2.2) from one scene in RDF."""
    files = json.loads((CASES / "spz_axes.json").read_text())
    scenes = {name: decode_spz(base64.b64decode(data), Path(name)) for name, data in files.items()}
    wanted = scenes["RDF"]
    assert len(scenes) == 16 and len(wanted) == 2 and wanted.sh_degree == 3
    for name, scene in scenes.items():
        assert torch.equal(scene.means, wanted.means), name
        # quarter turns round to other quaternions of 9 bits, and other SH of 8 bits
        largest = covariances(wanted).abs().amax((1, 2), keepdim=True)
        assert float(((covariances(scene) - covariances(wanted)) / largest).abs().max()) < 0.01
        apart = (scene.features_rest - wanted.features_rest).abs().max()
        assert float(apart) <= (0 if name[1] in "DU" else 0.04), name


def test_lichtfeld_s_file_is_turned_back_by_the_axes_that_it_declares(caplog):
    caplog.set_level("INFO")
    scene = ps.load(CASES / "spz4_rub_extension.spz")
    assert "turned back from the axes that it declares, RUB" in caplog.text
    # LichtFeld's own frame and that of its PLYs is RDF: the room with -y up
    room = ps.place(ps.example_room()[::300].replace(up="z"), up="-y")
    torch.testing.assert_close(scene.means, room.means, rtol=0, atol=1e-6)
    assert psnr_to(room, scene) > 44
    data = (CASES / "spz4_rub_extension.spz").read_bytes()
    undeclared = decode_spz(data[:14] + b"\0" + data[15:], Path("a"))
    assert psnr_to(room, undeclared) < 15


def test_a_file_that_is_written_and_read_keeps_its_axes(tmp_path, caplog):
    scene = ps.example_room()[::500]
    ps.save(scene, tmp_path / "a.spz")
    assert torch.equal(ps.load(tmp_path / "a.spz").means, scene.means)
    assert not caplog.messages


def test_in_gltf_the_nodes_turn_and_declared_axes_do_not(tmp_path):
    scene = ps.load(CASES / "spz4_rub_extension.spz")
    data = (CASES / "spz4_rub_extension.spz").read_bytes()
    kept = decode_spz(data, Path("a"), axes=False)
    signs = torch.tensor([1.0, -1.0, -1.0])
    assert torch.equal(kept.means, scene.means * signs)
    packed = pack_glb(content_with_spz(kept, len(data), {}), data)
    (tmp_path / "a.glb").write_bytes(packed)
    (tmp_path / "b.glb").write_bytes(
        pack_glb(content_with_spz(kept, len(plain := encode_spz(kept, version=3)), {}), plain)
    )
    assert torch.equal(ps.load(tmp_path / "a.glb").means, ps.load(tmp_path / "b.glb").means)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_axes_are_read_in_every_version_that_can_declare_them(version):
    scene = cloud(30, 1, 1)
    declared = record(AXES, struct.pack("<I", 4))
    data = encode_spz4(scene, declared) if version == 4 else gzipped(version, 2, declared, scene)
    plain = decode_spz(encode_spz(scene, version=version), Path("a"))
    signs = torch.tensor([1.0, -1.0, -1.0])
    assert torch.equal(decode_spz(data, Path("a")).means, plain.means * signs)


def test_other_extensions_are_named_with_their_type_and_ignored(tmp_path, caplog):
    scene = cloud(500, 1, 2)
    extensions = record(0xABCD0007, b"what") + record(0x12, b"")
    (tmp_path / "4.spz").write_bytes(encode_spz4(scene, extensions))
    (tmp_path / "3.spz").write_bytes(gzipped(3, 2, extensions, scene))
    wanted = decode_spz(encode_spz(scene), Path("a"))
    for name in ("3.spz", "4.spz"):
        caplog.clear()
        assert same_bits(ps.load(tmp_path / name), wanted)
        said = f"{tmp_path / name}: an extension of the SPZ file, type "
        assert caplog.messages == [
            f"{said}0xABCD0007 with 4 bytes, is ignored",
            f"{said}0x00000012 with 0 bytes, is ignored",
        ]


@pytest.mark.parametrize("axes", [0, 17, 2**32 - 1])
def test_unknown_axes_are_said_and_ignored(axes, caplog):
    scene = cloud(5)
    data = encode_spz4(scene, record(AXES, struct.pack("<I", axes)))
    assert same_bits(decode_spz(data, Path("a")), decode_spz(encode_spz(scene), Path("a")))
    assert f"declares unknown axes ({axes})" in caplog.text


@pytest.mark.parametrize(
    ("extensions", "said"),
    [
        (record(AXES, b"abc"), "declares the axes has 3 bytes; expected 4"),
        (record(7, b"abcd")[:-1], "an extension of the SPZ file ends after 11 of 12 bytes"),
        (struct.pack("<II", 7, 2**32 - 1), "ends after 8 of 4294967303 bytes"),
        (b"abc", "ends after 3 of"),
        (65 * record(7, b""), "more than 64 extensions"),
    ],
)
def test_damaged_extensions_are_refused(tmp_path, extensions, said):
    scene = cloud(5)
    for data in (encode_spz4(scene, extensions), gzipped(3, 2, extensions, scene)):
        (tmp_path / "a.spz").write_bytes(data)
        fails(lambda: ps.load(tmp_path / "a.spz"), said, error=ps.SceneError)


# Flags


@pytest.mark.parametrize("version", [2, 3, 4])
def test_unknown_flags_are_named(version, caplog):
    scene = normal_scene(5)
    data = bytearray(gzip.decompress(encode_spz(scene, version=version)) if version < 4 else b"")
    if version < 4:
        data[14] |= 0x44
        decode_spz(gzip.compress(bytes(data)), Path("a"))
    else:
        data = bytearray(encode_spz(scene))
        data[14] |= 0x44
        decode_spz(bytes(data), Path("a"))
    assert "a: flags of the SPZ file that are not known (0x04, 0x40) are ignored" in caplog.text


def test_of_spark_s_levels_the_leaves_are_read(caplog):
    caplog.set_level("INFO")
    scene = ps.load(CASES / "spark_lod.spz")
    assert "the 315 leaves of 426 nodes are read" in caplog.text
    room = ps.example_room()[::200]
    nearest = torch.cdist(room.means.double(), scene.means.double()).min(dim=1)
    assert len(scene) == len(room) == 315 and float(nearest.values.max()) < 2.0**-12
    assert sorted(nearest.indices.tolist()) == [*range(315)]
    assert psnr_to(room, scene) > 43  # all nodes at half of their opacities have 20


def tree(children, first):
    return struct.pack(f"<{len(children)}H", *children) + struct.pack(f"<{len(first)}I", *first)


def test_opacities_of_a_tree_are_doubled_and_at_most_1():
    scene = cloud(4)
    alphas = torch.tensor([0.9, 0.25, 0.5, 0.8])
    scene = scene.replace(opacities=alphas.logit()[:, None])
    leaves = decode_spz(gzipped(3, 0x80, tree([3, 0, 0, 0], [1, 0, 0, 0]), scene), Path("a"))
    torch.testing.assert_close(leaves.alphas, torch.tensor([0.5, 1.0, 1.0]), rtol=0, atol=2 / 255)


@pytest.mark.parametrize(
    ("links", "said"),
    [
        (tree([3, 0, 0, 0], [1, 0, 0, 0])[:-1], "truncated"),
        (tree([3, 0, 0, 0], [2, 0, 0, 0]), "are no tree"),  # beyond the last
        (tree([2, 2, 0, 0], [1, 2, 0, 0]), "are no tree"),  # too many children
        (tree([1, 1, 1, 0], [1, 1, 3, 0]), "are no tree"),  # a node with two parents
        (tree([65535, 0, 0, 0], [2**32 - 1, 0, 0, 0]), "are no tree"),
    ],
)
def test_links_that_are_no_tree_are_refused(tmp_path, links, said):
    (tmp_path / "a.spz").write_bytes(gzipped(2, 0x80, links, cloud(4)))
    fails(lambda: ps.load(tmp_path / "a.spz"), said, error=ps.SceneError)


def test_levels_in_version_4_are_refused_by_name(tmp_path):
    data = bytearray(encode_spz(cloud(4)))
    data[14] |= 0x80
    (tmp_path / "a.spz").write_bytes(data)
    fails(lambda: ps.load(tmp_path / "a.spz"), "Spark's levels of detail", error=ps.SceneError)
