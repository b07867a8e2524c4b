"""The file that a scene is read from, by what it holds."""

import hashlib
import shutil

import pytest

import pointsplat_ns as ps
from making import normal_scene
from pointsplat_ns.io.source import source_file


def test_of_a_file_it_is_the_hash_of_its_bytes(tmp_path):
    path = tmp_path / "room.ply"
    ps.save(normal_scene(5), path)
    source = source_file(path)
    data = path.read_bytes()
    assert (source.name, source.bytes, source.sha256) == ("room.ply", len(data), hashlib.sha256(data).hexdigest())


def test_a_sog_folder_is_known_by_all_its_files(tmp_path):
    folder = tmp_path / "room"
    ps.save(normal_scene(5), folder / "meta.json")
    source = source_file(folder)
    assert source.name == "room" and source == source_file(folder / "meta.json")
    assert source.bytes == sum(part.stat().st_size for part in folder.iterdir())
    shutil.copytree(folder, tmp_path / "copy")
    assert source_file(tmp_path / "copy").sha256 == source.sha256
    (folder / "notes.txt").write_text("not of the scene")
    assert source_file(folder) == source
    image = folder / "means_l.webp"
    image.write_bytes(image.read_bytes() + b"\0")
    assert source_file(folder).sha256 != source.sha256


@pytest.mark.parametrize("name", ["missing.ply", "missing"])
def test_what_is_not_there_is_one_error(tmp_path, name):
    with pytest.raises(ps.SceneError, match=name):
        source_file(tmp_path / name)
