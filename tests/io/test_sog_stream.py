"""Streamed SOG: what is read of levels, surroundings and rows, and one SceneError for each lie."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import normal_scene, same
from pointsplat_ns.io.formats import format_name
from pointsplat_ns.io.formats.sog_stream import Node, read_sog_stream, write_sog_stream
from pointsplat_ns.io.source import source_file, source_parts

FINE, COARSE = 300, 60


@pytest.fixture()
def folder(tmp_path) -> Path:
    """Two levels in three leaves; of the finer level, the first two fill a file."""
    levels = [normal_scene(FINE, seed=1), normal_scene(COARSE, seed=2)]
    rows = [(torch.arange(100 * i, 100 * i + 100), torch.arange(20 * i, 20 * i + 20)) for i in range(3)]
    first, second, third = (Node(rows=leaf) for leaf in rows)
    meta = write_sog_stream(
        levels, Node(children=(Node(children=(first, second)), third)), tmp_path / "lod-meta.json", 150
    )
    assert meta["filenames"] == ["0_0/meta.json", "1_0/meta.json", "0_1/meta.json"]
    return tmp_path


def changed(folder: Path, **changes) -> Path:
    path = folder / "lod-meta.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return path


def test_each_level_is_read_whole_the_finest_by_default(folder):
    assert len(ps.load(folder)) == FINE and same(ps.load(folder), ps.load(folder / "lod-meta.json"))
    assert len(read_sog_stream(folder, 1)) == COARSE == len(read_sog_stream(folder, -1))
    assert format_name(folder) == "streamed SOG" == ps.info(folder).format


def test_rows_of_a_leaf_are_where_the_tree_says(folder):
    """SOG rounds positions to a share of the scene's size, so rows keep their places."""
    leaves = json.loads((folder / "lod-meta.json").read_text())["tree"]["children"]
    third = leaves[1]["lods"]["0"]
    assert third == {"file": 2, "offset": 0, "count": 100}
    assert [leaf["lods"]["0"]["offset"] for leaf in leaves[0]["children"]] == [0, 100]
    scene = normal_scene(FINE, seed=1)
    assert torch.allclose(ps.load(folder / "0_1" / "meta.json").means, scene.means[200:], atol=1e-3)
    assert torch.allclose(ps.load(folder / "0_0" / "meta.json").means, scene.means[:200], atol=1e-3)


def test_a_box_holds_one_standard_deviation_of_every_gaussian(folder):
    leaf = json.loads((folder / "lod-meta.json").read_text())["tree"]["children"][1]
    parts = [normal_scene(FINE, seed=1)[200:], normal_scene(COARSE, seed=2)[40:]]
    low = torch.cat([part.means - part.stds.amin(dim=1, keepdim=True) for part in parts]).amin(dim=0)
    far = torch.cat([part.means - 3**0.5 * part.stds.amax(dim=1, keepdim=True) for part in parts]).amin(dim=0)
    found = torch.tensor(leaf["bound"]["min"])
    assert bool((found <= low + 1e-5).all()) and bool((found >= far - 1e-5).all())


def test_surroundings_are_added_with_fewer_bands(folder):
    ps.save(normal_scene(7, degree=0), folder / "env" / "meta.json")
    changed(folder, environment="env/meta.json")
    scene = ps.load(folder)
    assert len(scene) == FINE + 7 and scene.sh_degree == normal_scene(1).sh_degree
    assert not scene.features_rest[FINE:].any()


def test_a_scene_is_known_by_all_its_files(folder):
    assert len(source_parts(folder)) == sum(path.is_file() for path in folder.rglob("*"))
    before = source_file(folder)
    assert before == source_file(folder / "lod-meta.json") and before.name == folder.name
    image = folder / "0_1" / "means_l.webp"
    image.write_bytes(image.read_bytes() + b"\0")
    assert source_file(folder).sha256 != before.sha256


def test_an_older_stream_is_replaced_and_nothing_is_left_of_a_failure(folder, monkeypatch):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    scene, leaf = normal_scene(30), Node(rows=(torch.arange(30),))
    with monkeypatch.context() as patch:
        patch.setattr("pointsplat_ns.io.formats.sog_stream.sog_parts", lambda *a, **k: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            write_sog_stream([scene], leaf, folder / "lod-meta.json", 10)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    write_sog_stream([scene], leaf, folder / "lod-meta.json", 10)
    assert len(ps.load(folder)) == 30


LIES = {
    "another version": ({"version": 2}, "version 1"),
    "no level": ({"lodLevels": 0}, "0 levels"),
    "levels of text": ({"lodLevels": "2"}, "'2' levels"),
    "names that are none": ({"filenames": [1, 2, 3]}, "filenames"),
    "one name twice": ({"filenames": ["0_0/meta.json"] * 3}, "filenames"),
    "a file above": ({"filenames": ["../meta.json", "b/meta.json", "c/meta.json"]}, "own folder"),
    "a file elsewhere": ({"filenames": ["/etc/meta.json", "b/meta.json", "c/meta.json"]}, "own folder"),
    "an address": ({"filenames": ["https://a.b/meta.json", "b/meta.json", "c/meta.json"]}, "own folder"),
    "a file of another kind": ({"filenames": ["passwd", "b/meta.json", "c/meta.json"]}, "meta.json or a .sog"),
    "surroundings above": ({"environment": "../x/meta.json"}, "own folder"),
    "no tree": ({"tree": None}, "node of the tree"),
    "children of text": ({"tree": {"children": "ab"}}, "node of the tree"),
    "a file beyond the last": ({"tree": {"lods": {"0": {"file": 3, "offset": 0, "count": 1}}}}, "file 3 of 3"),
    "rows below zero": ({"tree": {"lods": {"0": {"file": 0, "offset": -1, "count": 1}}}}, "whole numbers"),
    "rows that are infinite": ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 1e400}}}}, "whole numbers"),
    "too many rows": ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 201}}}}, "200 Gaussians"),
    "more than memory holds": ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 10**15}}}}, "memory"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_one_error(folder, lie):
    changes, said = LIES[lie]
    with pytest.raises(ps.SceneError, match=said):
        ps.load(changed(folder, **changes))


def test_a_deep_tree_and_a_missing_file_are_one_error(folder):
    deep = '{"lodLevels":1,"filenames":[],"tree":' + '{"children":[' * 100_000 + "]}" * 100_000 + "}"
    (folder / "0_1" / "quats.webp").unlink()
    with pytest.raises(ps.SceneError, match=r"quats\.webp"):
        ps.load(folder)
    (folder / "lod-meta.json").write_text(deep)
    with pytest.raises(ps.SceneError, match="damaged streamed SOG"):
        ps.load(folder)
    with pytest.raises(ps.SceneError, match="no level 2"):
        (folder / "lod-meta.json").write_text('{"lodLevels":2,"filenames":[],"tree":{}}')
        read_sog_stream(folder, 2)


def test_splat_transform_reads_every_level(folder, tmp_path):
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("no splat-transform on the path, so nothing else reads the stream")
    for level, count in enumerate((FINE, COARSE)):
        out = tmp_path / f"{level}.ply"
        subprocess.run(
            [program, "-w", "-L", str(level), folder / "lod-meta.json", out], check=True, capture_output=True
        )
        assert torch.allclose(ps.load(out).means, read_sog_stream(folder, level).means, atol=1e-5)
        assert len(ps.load(out)) == count
