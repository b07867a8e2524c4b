"""RAD files are read back by a reader of their own: every level's Gaussians, and the tree that they
are in."""

import json
import struct
import zlib

import numpy as np
import pytest
import torch
from nested_levels import nested, rows_of
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball, normal_scene
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.scene.formats import rad
from pointsplat_ns.tools.levels.paged import write_paged

pytestmark = pytest.mark.usefixtures("quick")

TYPES = {
    "f32_lebytes": "u1",
    "f16": "<f2",
    "ln_f16": "<f2",
    "r8": "u1",
    "s8": "i1",
    "oct88r8": "u1",
    "u16": "<u2",
    "u32": "<u4",
}
DIMS = {
    "center": 3,
    "alpha": 1,
    "rgb": 3,
    "scales": 3,
    "orientation": 3,
    "sh1": 9,
    "sh2": 15,
    "sh3": 21,
    "child_count": 1,
    "child_start": 1,
}


def described(data: bytes, magic: bytes) -> tuple[dict, int]:
    """The JSON at the start of bytes, and where what follows it begins."""
    assert data[:4] == magic
    (length,) = struct.unpack_from("<I", data, 4)
    return json.loads(data[8 : 8 + length]), 8 + -(-length // 8) * 8


def turned(codes: np.ndarray) -> torch.Tensor:
    """Rotation matrices of axes on an unfolded octahedron and angles, (N, 3) bytes."""
    u, v = (codes[:, :2] / 255 * 2 - 1).T
    z = 1 - abs(u) - abs(v)
    below = np.maximum(-z, 0)
    axis = np.stack(
        [u - np.where(u >= 0, below, -below), v - np.where(v >= 0, below, -below), z], axis=1
    )
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = codes[:, 2:] / 255 * np.pi / 2
    return rotation_matrices(
        torch.from_numpy(np.concatenate([np.cos(half), axis * np.sin(half)], axis=1))
    )


def read_rad(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """The description of a file, and the numbers (N, components) of each attribute."""
    head, start = described(data, b"RAD0")
    assert head["version"] == 1 and head["type"] == "gsplat" and head["lodTree"] is True
    assert (
        head["allChunkBytes"]
        == len(data) - start
        == sum(place["bytes"] for place in head["chunks"])
    )
    assert len(head["chunks"]) == -(-head["count"] // head["chunkSize"])
    columns: dict[str, list[np.ndarray]] = {}
    for index, place in enumerate(head["chunks"]):
        page = data[start + place["offset"] : start + place["offset"] + place["bytes"]]
        about, end = described(page, b"RADC")
        assert about["base"] == index * head["chunkSize"] and len(page) % 8 == 0
        assert (
            struct.unpack_from("<Q", page, end)
            == (about["payloadBytes"],)
            == (len(page) - end - 8,)
        )
        for attribute in about["properties"]:
            name = attribute["property"]
            kind = attribute["encoding"]
            first = end + 8 + attribute["offset"]
            assert attribute["offset"] % 8 == 0 and attribute["compression"] == "gz"
            raw = zlib.decompress(page[first : first + attribute["bytes"]], -15)
            table = np.frombuffer(raw, TYPES[kind])
            if kind == "f32_lebytes":
                planes = table.reshape(4, 3, about["count"]).transpose(1, 2, 0)
                values = np.ascontiguousarray(planes).view("<f4")[..., 0].T
            elif kind == "oct88r8":
                values = table.reshape(about["count"], 3)
            else:
                values = table.reshape(DIMS[name], about["count"]).T.astype(np.float64)
            if kind == "r8":
                values = values / 255 * (attribute["max"] - attribute["min"]) + attribute["min"]
            if kind == "s8":
                values = values / 127 * attribute["max"]
            columns.setdefault(name, []).append(values)
    return head, {name: np.concatenate(parts) for name, parts in columns.items()}


@pytest.mark.parametrize(
    ("counts", "degree", "page"),
    [
        ((1,), 0, 100),
        ((1, 1), 3, 100),
        ((40,), 1, 100),
        ((700, 60, 9), 2, 100),
        ((300, 40), 3, 65536),
    ],
)
def test_a_file_holds_the_tree_of_all_levels(counts, degree, page, tmp_path, monkeypatch):
    monkeypatch.setattr(rad, "_PAGE", page)
    levels, parents = nested(counts, degree)
    written = write_paged(tmp_path / "a.rad", levels, parents)
    head, table = read_rad((tmp_path / "a.rad").read_bytes())
    kept = [len(level) for level in levels]
    kept[0] -= (
        len(levels[0]) // 9 if parents else int((levels[0].alphas == 0).sum())
    )  # merging leaves out the faint
    assert head["count"] == written == len(table["center"]) and head["maxSh"] == degree
    assert {*table} == {
        name for name in DIMS if not name.startswith("sh") or int(name[2]) <= degree
    }
    starts, sizes = (table[name][:, 0].astype(int) for name in ("child_start", "child_count"))
    below = [
        child
        for start, size in zip(starts, sizes, strict=True)
        for child in range(start, start + size)
    ]
    assert sorted(below) == [*range(1, written)], "each but the first is a child once"
    depth = np.zeros(written, int)
    for node in range(written):  # parents come first
        depth[starts[node] : starts[node] + sizes[node]] = depth[node] + 1
    deepest = int(depth.max())
    rows = {}
    for level, scene in enumerate(levels):
        nodes = np.flatnonzero(depth == deepest - level)
        assert len(nodes) == kept[level]
        found = rows_of(torch.from_numpy(table["center"][nodes]), scene, 0.0)
        rows.update({(level, int(node)): row for node, row in zip(nodes, found, strict=True)})
        part = scene[found]
        assert np.allclose(table["alpha"][nodes, 0], part.alphas.numpy(), atol=2**-11)
        assert np.allclose(table["scales"][nodes], part.scales.numpy(), rtol=2**-10, atol=1e-4)
        colours = (0.5 + SH_C0 * part.features_dc.numpy()).clip(
            head["splatEncoding"]["rgbMin"], head["splatEncoding"]["rgbMax"]
        )
        step = (head["splatEncoding"]["rgbMax"] - head["splatEncoding"]["rgbMin"]) / 255
        assert np.abs(table["rgb"][nodes] - colours).max() <= 0.51 * step
        apart = turned(table["orientation"][nodes]).float() - rotation_matrices(part.quats)
        assert float(apart.abs().max()) < 0.04, "an axis is within 2 degrees"
        for band in range(1, degree + 1):
            most = head["splatEncoding"][f"sh{band}Max"]
            wanted = (
                part.features_rest[:, band**2 - 1 : (band + 1) ** 2 - 1]
                .reshape(len(nodes), -1)
                .numpy()
            )
            assert np.abs(table[f"sh{band}"][nodes] - wanted).max() <= 0.51 * most / 127
    for (level, node), row in rows.items():
        if level:
            children = {
                rows[level - 1, child] for child in range(starts[node], starts[node] + sizes[node])
            }
            assert children == set((parents[level - 1] == row).nonzero()[:, 0].tolist())


def test_flat_axes_and_an_offset_are_kept(tmp_path, caplog):
    scene = normal_scene(3, 0).replace(offset=(1e6, -2.5, 3e5))
    scene.scales[:, 2] = -torch.inf
    write_paged(tmp_path / "a.rad", [scene], [])
    head, table = read_rad((tmp_path / "a.rad").read_bytes())
    assert head["comment"] == "Offset: 1000000.0 -2.5 300000.0" and "lost" not in caplog.text
    assert ps.load(tmp_path / "a.rad").offset == (1e6, -2.5, 3e5)
    assert np.exp(table["scales"][-3:, 2]).max() == 0.0


def test_more_children_than_the_format_counts_are_refused(tmp_path):
    with pytest.raises(
        ps.SceneError, match="stands for 65536 of the next level; expected at most 65535; make more"
    ):
        write_paged(
            tmp_path / "a.rad",
            [normal_scene(65536, 0), normal_scene(1, 0)],
            [torch.zeros(65536).long()],
        )
    assert not (tmp_path / "a.rad").exists()


def test_the_command_writes_a_file_and_replaces_one_only_by_force(tmp_path, capsys):
    ps.save(ball(200, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    words = (
        "lod",
        tmp_path / "room.ply",
        "--levels",
        "10%",
        "-o",
        tmp_path / "a.rad",
        "--resolution",
        "48x36",
    )
    run(*words)
    written = (tmp_path / "a.rad").read_bytes()
    head, table = read_rad(written)
    assert int((table["child_count"] == 0).sum()) == 200 and head["count"] > 220
    assert "a.rad: exists already" in refusal(capsys, tmp_path, *words)
    assert (tmp_path / "a.rad").read_bytes() == written
    run(*words, "--force")
    assert (tmp_path / "a.rad").read_bytes() == written
