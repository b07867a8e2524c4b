"""3D Tiles are read back by a reader of their own: every Gaussian once, each tile replaced by its
children."""

import gzip
import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from nested_levels import nested, rows_of
from refusing import refusal

import pointsplat_ns as ps
from making import ball, normal_scene
from pointsplat_ns.geometry.earth import Place
from pointsplat_ns.system.progress import silent
from pointsplat_ns.tools.levels.level_errors import pixel_size_for
from pointsplat_ns.tools.levels.levels import LevelOutput
from pointsplat_ns.tools.levels.tiles_3d import write_tiles

pytestmark = pytest.mark.usefixtures("quick")

TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
"""What viewers of 3D Tiles do to glTF."""


def read_tile(path: Path) -> dict[str, np.ndarray]:
    """The numbers of a tile: positions (N, 3) in the frame of its tileset's root, and bytes of the
    others."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON") and length % 4 == 0
    content = json.loads(data[20 : 20 + length])
    binary, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and 28 + length + binary == size and binary % 4 == 0
    (primitive,) = content["meshes"][0]["primitives"]
    view = primitive["extensions"]["KHR_gaussian_splatting"]["extensions"][
        "KHR_gaussian_splatting_compression_spz_2"
    ]
    assert view["bufferView"] == 0 and len(content["extensionsRequired"]) == 2
    length_of_spz = content["bufferViews"][0]["byteLength"]
    spz = gzip.decompress(data[28 + length : 28 + length + length_of_spz])
    magic, version, count, degree, bits, _, _ = struct.unpack_from("<4sIIBBBB", spz)
    assert (magic, version) == (b"NGSP", 3)
    coefficients = 3 * ((degree + 1) ** 2 - 1)
    names = [f"SH_DEGREE_{d}_COEF_{i}" for d in range(1, degree + 1) for i in range(2 * d + 1)]
    wanted = {
        "POSITION",
        "COLOR_0",
        *(f"KHR_gaussian_splatting:{name}" for name in ("SCALE", "ROTATION", *names)),
    }
    assert primitive["attributes"].keys() == wanted
    assert {accessor["count"] for accessor in content["accessors"]} == {count}
    parts = np.split(
        np.frombuffer(spz, np.uint8, offset=16), np.cumsum([9 * count, count, 3 * count, 3 * count])
    )
    assert len(parts[4]) == (4 + coefficients) * count
    three = parts[0].reshape(count, 3, 3).astype(np.int64) @ [1, 1 << 8, 1 << 16]
    local = np.where(three >= 1 << 23, three - (1 << 24), three) / 2.0**bits
    node = TO_Z_UP @ np.array(content["nodes"][0]["matrix"]).reshape(4, 4).T
    return {
        "positions": local @ node[:3, :3].T + node[:3, 3],
        "alphas": parts[1] / 255,
        "scales": parts[3].reshape(count, 3) / 16 - 10.0,
        "step": np.array(2.0**-bits),
    }


def tiles_of(folder: Path) -> tuple[dict, list[tuple[dict, dict | None]]]:
    """The tileset, and every tile with content beside the one above."""
    tileset = json.loads((folder / "tileset.json").read_text())
    found = []
    waiting = [(tileset["root"], None)]
    while waiting:
        tile, above = waiting.pop()
        if "content" in tile:
            found.append((tile, above))
        waiting += [(child, tile) for child in tile.get("children", [])]
    return tileset, found


@pytest.mark.parametrize(
    ("counts", "degree"),
    [((1,), 0), ((1, 1), 3), ((40,), 1), ((700, 60, 9), 2), ((900, 300, 100, 5), 3)],
)
def test_tiles_hold_each_level_once_and_children_replace_a_tile(counts, degree, tmp_path):
    levels, parents = nested(counts, degree)
    sizes = [0.01 * 3**level for level in range(len(counts))]
    written = write_tiles(tmp_path, levels, parents, sizes, torch.eye(4).double(), most=64)
    _, tiles = tiles_of(tmp_path)
    rows: dict[str, tuple[int, list[int]]] = {}
    for tile, _ in tiles:
        uri = tile["content"]["uri"]
        level = int(Path(uri).name.split("_")[0])
        content = read_tile(tmp_path / uri)
        rows[uri] = (
            level,
            rows_of(torch.from_numpy(content["positions"]), levels[level], float(content["step"])),
        )
        part = levels[level][rows[uri][1]]
        assert np.abs(content["alphas"] - part.alphas.numpy()).max() <= 0.5 / 255 + 1e-6
        assert np.abs(content["scales"] - part.scales.numpy()).max() <= 0.5 / 16 + 1e-6
        box = np.array(tile["boundingVolume"]["box"])
        assert (np.abs(part.means.numpy() - box[:3]) <= box[3::4]).all(), (
            "the box holds its Gaussians"
        )
    for level, scene in enumerate(levels):
        all_rows = sorted(row for of, some in rows.values() for row in some if of == level)
        kept = set(range(len(scene))) - (
            {*range(8, len(scene), 9)} if level == 0 and parents else set()
        )
        assert all_rows == sorted(kept) and written[level] == len(kept)
    for tile, _ in tiles:
        level, some = rows[tile["content"]["uri"]]
        children = [rows[child["content"]["uri"]][1] for child in tile.get("children", [])]
        assert bool(children) == (level > 0) and tile["geometricError"] == (
            16 * sizes[level] if children else 0
        )
        if children:
            finer = {row for child in children for row in child}
            assert finer == {
                row for row, parent in enumerate(parents[level - 1].tolist()) if parent in set(some)
            }
        assert all(
            len(child) <= 64 or len({int(parents[level - 1][row]) for row in child}) == 1
            for child in children
        )


def test_a_tileset_says_what_viewers_ask_for(tmp_path):
    levels, parents = nested((700, 60), 1)
    matrix = torch.tensor(
        [[0.0, -1, 0, 5e6], [1, 0, 0, 7], [0, 0, 1, -3], [0, 0, 0, 1]], dtype=torch.float64
    )
    write_tiles(tmp_path, levels, parents, [0.5, 0.25], matrix, most=100)
    tileset, tiles = tiles_of(tmp_path)
    needed = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert tileset["asset"]["version"] == "1.1" and tileset["extensionsUsed"] == [
        "3DTILES_content_gltf"
    ]
    assert tileset["extensions"]["3DTILES_content_gltf"] == {
        "extensionsUsed": needed,
        "extensionsRequired": needed,
    }
    assert tileset["root"]["refine"] == "REPLACE"
    assert tileset["root"]["transform"] == matrix.T.flatten().tolist()
    assert all(above["geometricError"] >= tile["geometricError"] for tile, above in tiles)
    assert {tile["geometricError"] for tile, _ in tiles} == {8.0, 0.0}, (
        "a coarser level has no smaller error"
    )
    for tile, above in tiles:
        inner, outer = (np.array(of["boundingVolume"]["box"]) for of in (tile, above))
        assert (np.abs(inner[:3] - outer[:3]) + inner[3::4] <= outer[3::4] + 1e-12).all()


@pytest.mark.parametrize(
    ("at", "offset", "up"),
    [
        (None, None, None),
        (None, (1e6, -2e6, 3e5), None),
        ("EPSG:32632", (513_000.0, 5_403_000.0, 300.0), None),
        ("48.78,9.18,300", None, "-y"),
        ("48.78,9.18,300", (1e6, 0.0, 0.0), "z"),
    ],
)
def test_tiles_lie_where_the_scene_does(at, offset, up, tmp_path):
    scene = ball(300, opacity=1.0, bright=1.0).replace(offset=offset, up=up)
    views = ps.sample_views(scene, 2, 48, 36)
    ps.lod(scene, ["100%", "10%"], views=views, folder=tmp_path / "out", tiles=True, at=at)
    tileset, tiles = tiles_of(tmp_path / "out")
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    paths = [
        tmp_path / "out" / tile["content"]["uri"]
        for tile, _ in tiles
        if tile["geometricError"] == 0
    ]
    contents = [read_tile(path) for path in paths]
    found = torch.from_numpy(
        np.concatenate([part["positions"] for part in contents]) @ matrix[:3, :3].T
    )
    found += torch.from_numpy(matrix[:3, 3])
    means = scene.means.double()
    turns = {
        None: torch.eye(3),
        "z": torch.eye(3),
        "-y": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    }
    if at is None:
        wanted = means + torch.tensor(offset or (0.0, 0.0, 0.0), dtype=torch.float64)
    elif at.startswith("EPSG"):
        about = Place.parse(at).frame(
            torch.tensor(offset, dtype=torch.float64), torch.eye(3).double()
        )
        wanted = means @ about[:3, :3].T + about[:3, 3]
    else:
        about = Place.parse(at).frame(torch.zeros(3, dtype=torch.float64), turns[up].double())
        wanted = means @ about[:3, :3].T + about[:3, 3]
    # A zone's scale is 0.9996 in its middle, and heights have none: 2 units of height differ by
    # 0.0008.
    most = float(contents[0]["step"]) + (1e-3 if at and at.startswith("EPSG") else 1e-6)
    middle = wanted.mean(0)
    apart = torch.cdist(
        found - middle, wanted - middle, compute_mode="donot_use_mm_for_euclid_dist"
    )
    assert len(found) == 300 and float(apart.min(dim=1).values.max()) <= most
    assert float(apart.min(dim=0).values.max()) <= most


def test_older_tiles_need_force_and_stay_when_writing_fails(tmp_path, monkeypatch, capsys):
    levels, parents = nested((60, 9), 0)
    write_tiles(tmp_path / "a", levels, parents, [1.0, 2.0], torch.eye(4).double())
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ps.SceneError, match=r"tileset\.json: exists already"):
        LevelOutput(tmp_path / "a", "tiles", None, None, force=False).check(2)
    monkeypatch.setattr("pointsplat_ns.tools.levels.tiles_3d.encode_tile", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_tiles(tmp_path / "a", levels, parents, [1.0, 2.0], torch.eye(4).double())
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    ps.save(normal_scene(20), tmp_path / "room.ply")
    for options, words in (
        (("--tiles", "--stream"), "either a stream or 3D Tiles"),
        (("--at", "1,2"), "a place on the Earth needs tiles"),
        (("--tiles", "--at", "Paris"), "expected a UTM zone"),
        (("--tiles", "-o", tmp_path / "a.rad"), "expected the name of a folder"),
    ):
        assert words in refusal(capsys, tmp_path, "lod", tmp_path / "room.ply", *options)


def test_levels_without_views_have_the_errors_of_their_sizes(tmp_path):
    scene = ball(300, opacity=1.0, bright=1.0)
    made = replace(
        ps.lod(scene, ["100%", "10%"], views=ps.sample_views(scene, 2, 48, 36)), views=None
    )
    LevelOutput(tmp_path, "tiles", None, None, force=False).write(made, silent)
    _, tiles = tiles_of(tmp_path)
    wanted = 16 * float(made[1].scene.stds.median(dim=1).values.median())
    assert max(tile["geometricError"] for tile, _ in tiles) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize(
    ("psnr", "dense", "factor"),
    [
        ((24.0, 27.0, 30.0, 33.0), {}, 4.0),
        ((24.0, 26.0, 28.0, 30.0), {2: 60.0, 4: 60.0, 8: 60.0}, 8.0),
        ((27.0, 27.0, 27.0, 27.0), {2: 24.0, 4: 24.0, 8: 24.0}, None),
        ((math.inf,), {}, 1 / 8),
        ((0.0,), {}, 64.0),
        ((math.inf, math.inf), {2: math.inf}, 1 / 8),
    ],
)
def test_a_pixel_is_as_large_as_where_a_level_shows_enough(psnr, dense, factor):
    found = (
        pixel_size_for({1 << step: value for step, value in enumerate(psnr)}, dense, 0.01) / 0.01
    )
    assert found == pytest.approx(factor) if factor else 1 / 8 <= found < 2
