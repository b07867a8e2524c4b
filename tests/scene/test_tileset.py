"""3D Tiles are read: those that are written here, and trees of tiles as other programs write."""

import json
import math

import pytest
import torch
from gltfs import glb_of
from nested_levels import nested, rows_of
from refusing import fails

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.geometry.earth import Place, local_frame
from pointsplat_ns.scene.discovery import find_scenes
from pointsplat_ns.scene.reading import kind_of, source_file
from pointsplat_ns.tools.levels.tiles_3d import placed, write_tiles

Z_UP = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
IDENTITY = torch.eye(4, dtype=torch.float64)


def columns(scale: float, *moved: float) -> list[float]:
    return [scale, 0, 0, 0, 0, scale, 0, 0, 0, 0, scale, 0, *moved, 1]


def write(folder, root: dict, **asset: str) -> None:
    content = {"asset": {"version": "1.1", **asset}, "root": root}
    (folder / "tileset.json").write_text(json.dumps(content))


@pytest.fixture
def tiles(tmp_path):
    """A folder of three tiles, and their scenes."""
    scenes = [cloud(20 + index, index, index) for index in range(3)]
    (tmp_path / "in").mkdir()
    for index, scene in enumerate(scenes):
        (tmp_path / "in" / f"{index}.glb").write_bytes(glb_of(scene).glb())
    return tmp_path, scenes


def tile(index: int, **more: object) -> dict:
    return {"content": {"uri": f"in/{index}.glb"}, **more}


def z_up(scene: ps.Gaussians) -> torch.Tensor:
    return scene.means @ torch.tensor(Z_UP, dtype=torch.float32).T


@pytest.mark.parametrize("degree", [1, 3])
def test_tiles_that_are_written_come_back_as_the_finest_level(tmp_path, degree):
    levels, parents = nested((700, 60, 9), degree)
    matrix = IDENTITY.clone()
    matrix[:3, 3] = torch.tensor([100.0, -20, 3])
    write_tiles(tmp_path / "t", levels, parents, [0.1, 0.2, 0.4], matrix, most=64)
    back = ps.load(tmp_path / "t")
    kept = [row for row in range(700) if row % 9 != 8]
    assert len(back) == len(kept) and back.sh_degree == degree and back.up is None
    moved = back.replace(means=back.means - torch.tensor([100.0, -20, 3]))
    rows = rows_of(moved.means, levels[0], 0.01)
    assert sorted(rows) == kept
    part = levels[0][rows]
    assert (back.scales - part.scales).abs().max() < 0.5 / 16 + 1e-5
    assert (back.alphas - part.alphas).abs().max() < 0.51 / 255 + 1e-6
    assert (back.features_rest - part.features_rest.clamp(-1, 127 / 128)).abs().mean() < 0.05
    assert kind_of(tmp_path / "t") == kind_of(tmp_path / "t" / "tileset.json") == "3D Tiles"
    files = [path for path in (tmp_path / "t").rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    assert source_file(tmp_path / "t")[:2] == ("t", size)


def test_the_up_axis_of_the_scene_comes_back(tmp_path):
    levels, parents = nested((40, 5), 1)
    levels[0] = levels[0].replace(up="-y")
    write_tiles(tmp_path, levels, parents, [0.1, 0.2], IDENTITY)
    assert ps.load(tmp_path).up == "-y"


def test_tiles_on_the_globe_are_read_level_and_in_full_precision(tmp_path, caplog):
    scene = cloud(300, 1, 2).replace(up="z")
    levels, matrix = placed([scene], scene, "48.8584,2.2945,35", None)
    write_tiles(tmp_path, levels, [], [0.1], matrix)
    back = ps.load(tmp_path)
    assert back.up == "z" and "placed on the globe" in caplog.text
    at = torch.tensor(back.offset or (0.0, 0.0, 0.0))
    # the middle of the tiles is above the origin: only the height and the origin differ
    shift = (back.means + at).double().mean(dim=0) - scene.means.double().mean(dim=0)
    rows = rows_of((back.means + at).double() - shift, scene, 2e-3)
    assert sorted(rows) == list(range(300)) and abs(float(shift[2]) - 35) < 0.1
    order = torch.tensor(rows)
    assert (back.features_rest - scene.features_rest[order]).abs().max() < 0.04


@pytest.mark.parametrize("latitude", [-89.99, -33.0, 0.0, 48.8, 90.0])
def test_the_frame_at_a_place_is_east_north_up(latitude):
    frame = Place(None, (latitude, 151.0, 500.0)).frame(
        torch.zeros(3).double(), torch.eye(3).double()
    )
    found = local_frame(frame[:3, 3])
    assert found is not None
    torch.testing.assert_close(found[:3, 2], frame[:3, 2], rtol=0, atol=1e-5)
    height = float((frame[:3, 3] - found[:3, 3]) @ found[:3, 2])
    assert math.isclose(height, 500, abs_tol=0.1)
    assert local_frame(0.9 * frame[:3, 3]) is None and local_frame(torch.zeros(3).double()) is None


def test_children_replace_a_tile_or_are_added_to_it(tiles):
    folder, scenes = tiles
    write(folder, tile(0, refine="REPLACE", children=[tile(1), tile(2)]))
    back = ps.load(folder)
    assert torch.equal(back.means, torch.cat([z_up(scenes[1]), z_up(scenes[2])]))
    assert back.up == "z" and back.sh_degree == 2
    write(folder, tile(0, refine="ADD", children=[tile(1), tile(2)]))
    assert len(ps.load(folder)) == sum(map(len, scenes))
    write(folder, tile(0, refine="ADD", children=[tile(1, refine="REPLACE", children=[tile(2)])]))
    assert len(ps.load(folder)) == len(scenes[0]) + len(scenes[2])


def test_transforms_of_tiles_and_nested_tilesets_are_applied(tiles):
    folder, scenes = tiles
    inner = {"asset": {}, "root": {"transform": columns(1, 1, 0, 0), "content": {"url": "0.glb"}}}
    (folder / "in" / "more.json").write_text(json.dumps(inner))
    write(
        folder,
        {
            "transform": columns(2, 0, 0, 7),
            "children": [{"contents": [{"uri": "in/more.json"}]}, tile(1)],
        },
    )
    back = ps.load(folder / "tileset.json")
    first = 2 * (z_up(scenes[0]) + torch.tensor([1.0, 0, 0])) + torch.tensor([0, 0, 7.0])
    second = 2 * z_up(scenes[1]) + torch.tensor([0, 0, 7.0])
    torch.testing.assert_close(back.means, torch.cat([first, second]), rtol=0, atol=1e-5)
    torch.testing.assert_close(back.scales[:20], scenes[0].scales + math.log(2), rtol=0, atol=1e-5)


def test_gltf_with_z_up_stays(tiles):
    folder, scenes = tiles
    write(folder, tile(0), gltfUpAxis="Z")
    assert torch.equal(ps.load(folder).means, scenes[0].means)


REFUSED = {
    "tiles of .b3dm files are not read": {"content": {"uri": "in/0.b3dm"}},
    "own folder": {"content": {"uri": "../0.glb"}},
    "implicit tiling is not read": {"implicitTiling": {}, **tile(0)},
    "no tile has content": {"children": [{}]},
    "missing.glb: no such file": {"content": {"uri": "missing.glb"}},
    "tileset.json is named twice": {"content": {"uri": "tileset.json"}},
    "expected 16 numbers": {"transform": [1], **tile(0)},
}


@pytest.mark.parametrize("said", REFUSED)
def test_what_is_not_read_is_refused_in_one_line(tiles, said):
    folder, _ = tiles
    write(folder, REFUSED[said])
    fails(lambda: ps.load(folder), said, error=ps.SceneError)


def test_the_tiles_of_a_tileset_are_no_scenes_of_a_folder(tmp_path):
    tiles = tmp_path / "tiles"
    tiles.mkdir()
    (tiles / "0.glb").write_bytes(glb_of(cloud(5)).glb())
    write(tiles, {"content": {"uri": "0.glb"}})
    ps.save(cloud(5), tmp_path / "room.ply")
    assert [*find_scenes(tmp_path)] == ["room"]
