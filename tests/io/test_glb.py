"""glTF files: their numbers, where nodes place Gaussians, and files that lie."""

from __future__ import annotations

import functools
import json
import struct

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.io.formats.spz import encode_spz


def test_holds_the_numbers_as_the_extension_names_them(tmp_path):
    scene = cloud(7, 0, 2)
    ps.save(scene, tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, text_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    content = json.loads(data[20 : 20 + text_length])
    binary = data[20 + text_length + 8 :]
    assert content["buffers"][0]["byteLength"] == len(binary)
    (primitive,) = content["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"

    def array(name):
        accessor = content["accessors"][primitive["attributes"][name]]
        view = content["bufferViews"][accessor["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, "u1" if accessor["componentType"] == 5121 else "<f4").reshape(accessor["count"], -1)

    named = functools.partial("KHR_gaussian_splatting:{}".format)
    assert np.array_equal(array("POSITION"), scene.means.numpy())
    assert np.array_equal(array(named("SCALE")), scene.stds.numpy())
    assert np.allclose(array(named("OPACITY"))[:, 0], scene.alphas.numpy())
    unit = torch.nn.functional.normalize(scene.quats, dim=1)[:, [1, 2, 3, 0]]  # xyzw
    assert np.allclose(array(named("ROTATION")), unit.numpy(), atol=1e-6)
    assert np.array_equal(array(named("SH_DEGREE_0_COEF_0")), scene.features_dc.numpy())
    assert np.array_equal(array(named("SH_DEGREE_2_COEF_4")), scene.features_rest[:, 7].numpy())
    assert len(primitive["attributes"]) == 2 + 3 + 9
    assert array("COLOR_0").shape == (7, 4)
    back = ps.load(tmp_path / "a.glb")
    assert torch.equal(back.means, scene.means) and torch.equal(back.sh, scene.sh)
    assert torch.allclose(back.scales, scene.scales, atol=1e-6) and torch.allclose(back.quats, unit[:, [3, 0, 1, 2]])
    assert torch.allclose(back.opacities, scene.opacities, rtol=1e-3, atol=1e-4)  # float32 opacities near 1


def packed(content, binary):
    """The bytes of a ``.glb``."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def glb_of(arrays, about=None, nodes=({"mesh": 0},), **changes):
    """The bytes of a ``.glb`` of one primitive: name of attribute to (array, normalized)."""
    accessors, views, binary = [], [], b""
    kinds = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "float32": 5126}
    for array, normalized in arrays.values():
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": kinds[array.dtype.name],
                "count": len(array),
                "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1]],
                "normalized": normalized,
            }
        )
        binary += array.tobytes() + bytes(-array.nbytes % 4)
    names = [name if name == "POSITION" else f"KHR_gaussian_splatting:{name}" for name in arrays]
    extension = {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **(about or {})}}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(names)}, "extensions": extension}
    content = {
        "asset": {"version": "2.0"},
        "nodes": list(nodes),
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
        **changes,
    }
    return packed(content, binary)


def small_integers():
    """Attributes of three Gaussians in the smallest types that the extension allows."""
    return {
        "POSITION": (np.arange(9, dtype=np.float32).reshape(3, 3), False),
        "ROTATION": (np.array([[0, 0, 0, 127], [127, 0, 0, 0], [0, -128, 0, 0]], np.int8), True),
        "SCALE": (np.array([[1, 2, 3], [4, 5, 6], [7, 8, 0]], np.int16), False),
        "OPACITY": (np.array([[0], [32768], [65535]], np.uint16), True),
        "SH_DEGREE_0_COEF_0": (np.ones((3, 3), np.float32), False),
    }


def with_nodes(path, nodes, copies=1, **changes):
    """The file of a scene, its mesh as often as there are to be copies, placed by other nodes."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    content = json.loads(data[20 : 20 + size]) | {"nodes": nodes, **changes}
    content["meshes"] *= copies
    path.write_bytes(packed(content, data[28 + size :]))
    return path


def test_is_read_where_its_nodes_place_it(tmp_path):
    scene = cloud(30, 2, 2)
    ps.save(scene, tmp_path / "a.glb")
    half = 0.5**0.5
    nodes = [  # 90 degrees about x, then 2 units up and half the size: (x, y, z) becomes (x, -z, y) / 2 + (0, 2, 0)
        {"children": [1], "translation": [0, 2, 0], "scale": [0.5] * 3},
        {"children": [2], "rotation": [half, 0, 0, half]},
        {"mesh": 0},
        {"mesh": 1, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]},  # mirrored and moved
        {"mesh": 0},  # not in the scene
    ]
    placed = ps.load(with_nodes(tmp_path / "a.glb", nodes, 2, scenes=[{}, {"nodes": [0, 3]}], scene=1))
    assert len(placed) == 60
    x, y, z = scene.means.T
    turned, mirrored = placed[:30], placed[30:]
    torch.testing.assert_close(turned.means, torch.stack([x, -z, y], 1) / 2 + torch.tensor([0.0, 2, 0]))
    torch.testing.assert_close(mirrored.means, torch.stack([7 - x, y + 8, z + 9], 1))
    torch.testing.assert_close(turned.scales, scene.scales - np.log(2), rtol=0, atol=1e-5)
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    for found, matrix, size in (
        (turned, torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), 0.25),
        (mirrored, flip, 1),
    ):
        axes = [rotation_matrices(s.quats) * s.stds[:, None] for s in (found, scene)]
        wanted = size * matrix @ (axes[1] @ axes[1].mT) @ matrix.T
        torch.testing.assert_close(axes[0] @ axes[0].mT, wanted, rtol=1e-3, atol=1e-5)


def test_of_uneven_nodes_says_that_they_are_not_applied(tmp_path, caplog):
    scene = cloud(5)
    ps.save(scene, tmp_path / "a.glb")
    back = ps.load(with_nodes(tmp_path / "a.glb", [{"mesh": 0, "scale": [2, 2, 3]}]))
    assert torch.equal(back.means, scene.means) and "scales unevenly is not applied" in caplog.text


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ([{"children": [0]}], "two parents"),
        ([{"children": [1, 1]}, {"mesh": 0}], "two parents"),
        ([{"children": [7]}], "entry 7 of 1"),
        ([{"mesh": 0, "rotation": [0, 0, 1]}], "damaged glTF"),
        ([{"mesh": 0, "matrix": [1.0] * 15}], "damaged glTF"),
        ([{"mesh": 0, "translation": [0, 0, float("inf")]}], "not finite"),
        ([{"children": [*range(1, 10_002)]}, *[{"mesh": 0}] * 10_001], "10001 nodes with Gaussians"),
    ],
)
def test_of_impossible_nodes_is_one_error(tmp_path, nodes, said):
    ps.save(cloud(2), tmp_path / "a.glb")
    with pytest.raises(ps.SceneError, match=said):
        ps.load(with_nodes(tmp_path / "a.glb", nodes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"meshes": []}, "no Gaussians"),
        ({"about": {"extensions": {"EXT_other_compression": {}}}}, "EXT_other_compression"),
        ({"about": {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {}}}}, "lacks 'bufferView'"),
        ({"about": {"kernel": "cube"}}, "the kernel cube"),
        ({"buffers": [{"byteLength": 1, "uri": "a.bin"}]}, "another file"),
        ({"accessors": []}, "damaged glTF"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 1 << 60}] * 5}, "truncated"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 1 << 60, "type": "VEC3"}] * 5}, "truncated"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": -1, "type": "VEC3"}] * 5}, "damaged glTF"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 1, "type": "MAT4"}] * 5}, "damaged glTF"),
        ({"accessors": [{"componentType": 5126, "count": 1, "type": "VEC3"}] * 5}, "sparse"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_that_lies_or_needs_more_is_one_error(tmp_path, changes, said):
    (tmp_path / "a.glb").write_bytes(glb_of(small_integers(), **changes))
    with pytest.raises(ps.SceneError, match=said):
        ps.load(tmp_path / "a.glb")


def spz_glb(data, extensions, copies=1, at=12):
    """A ``.glb`` whose primitives hold an SPZ file in a buffer view, behind some other bytes. Its accessors have no
    numbers: they are for programs that unpack it."""
    accessor = {"componentType": 5126, "count": 1, "type": "VEC3"}
    primitive = {"mode": 0, "attributes": {"POSITION": 0, "COLOR_0": 0}, "extensions": extensions}
    content = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, "translation": [0, 2, 0]}],
        "meshes": [{"primitives": [primitive] * copies}],
        "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteLength": at}, {"buffer": 0, "byteOffset": at, "byteLength": len(data)}],
        "buffers": [{"byteLength": at + len(data)}],
    }
    return packed(content, bytes(at) + data)


INNER = [f"KHR_gaussian_splatting_compression_spz{end}" for end in ("", "_2")]
WRAPPED = [
    *({"KHR_gaussian_splatting": {"extensions": {name: {"bufferView": 1}}}} for name in INNER),
    {"KHR_spz_gaussian_splats_compression": {"bufferView": 1}},
]


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("extensions", WRAPPED, ids=["draft", "spz_2", "old"])
def test_that_holds_spz_is_what_the_spz_holds_where_its_node_places_it(tmp_path, extensions, version):
    data = encode_spz(cloud(40, 2, 3), version=version)
    (tmp_path / "a.spz").write_bytes(data)
    (tmp_path / "a.glb").write_bytes(spz_glb(data, extensions))
    inside, found = ps.load(tmp_path / "a.spz"), ps.load(tmp_path / "a.glb")
    torch.testing.assert_close(found.means, inside.means + torch.tensor([0.0, 2.0, 0.0]))
    assert torch.equal(found.scales, inside.scales) and torch.allclose(found.sh, inside.sh, rtol=0, atol=1e-6)
    assert torch.equal(found.opacities, inside.opacities) and torch.equal(found.quats, inside.quats)


@pytest.mark.parametrize(
    ("data", "said"),
    [(b"no SPZ at all", "not an SPZ file"), (encode_spz(cloud(40))[:-20], "a.glb: .*"), (b"", "not an SPZ file")],
)
def test_whose_spz_is_damaged_is_one_error(tmp_path, data, said):
    (tmp_path / "a.glb").write_bytes(spz_glb(data, WRAPPED[1]))
    with pytest.raises(ps.SceneError, match=said):
        ps.load(tmp_path / "a.glb")


def test_whose_primitives_share_one_spz_takes_no_memory_for_each(tmp_path):
    """10,000 times 1,000 Gaussians that are all one."""
    scene = cloud(1)[torch.zeros(1000, dtype=torch.int64)]
    (tmp_path / "a.glb").write_bytes(spz_glb(encode_spz(scene), WRAPPED[1], 10_000))
    with pytest.raises(ps.SceneError, match="bytes cannot hold them"):
        ps.load(tmp_path / "a.glb")


def test_cut_anywhere_is_one_error(tmp_path):
    data = glb_of(small_integers())
    for size in range(0, len(data), 7):
        (tmp_path / "a.glb").write_bytes(data[:size])
        with pytest.raises(ps.SceneError):
            ps.load(tmp_path / "a.glb")
