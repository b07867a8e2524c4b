"""A pipe in place of a scene's file is refused when it is opened, whatever was there when its path
was looked at."""

import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.scene.camera_files import read_named_views
from pointsplat_ns.scene.camera_files.colmap import colmap_points
from pointsplat_ns.scene.formats import FORMATS, format_to_read
from pointsplat_ns.scene.inert_yaml import read_config
from pointsplat_ns.scene.ply import PlyRows

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes"),
    pytest.mark.usefixtures("time_limit"),
]

READ = {kind.name: kind for kind in FORMATS if kind.read}


@pytest.fixture
def unnoticed(monkeypatch) -> Callable[[Path], Path]:
    """A function that puts a pipe at a path, which looks like a regular file until it is opened."""
    pipes = set()
    usual = Path.is_file

    def piped(path: Path) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        os.mkfifo(path)
        pipes.add(str(path))
        return path

    monkeypatch.setattr(Path, "is_file", lambda path: str(path) in pipes or usual(path))
    return piped


def refused(read: Callable[[Path], object], path: Path) -> None:
    with pytest.raises(PointSplatError) as found:
        read(path)
    assert "\n" not in str(found.value) and str(path.parent) in str(found.value)


@pytest.mark.parametrize("name", READ)
def test_each_reader_refuses_a_pipe(name, unnoticed, tmp_path):
    kind = READ[name]
    path = unnoticed(tmp_path / f"a{kind.suffix}")
    refused(kind.read, path)
    refused(ps.load, path)


def test_the_format_of_a_pipe_is_not_looked_at(unnoticed, tmp_path):
    with pytest.raises(SceneError, match="a.ply: cannot be read .not a regular file"):
        format_to_read(unnoticed(tmp_path / "a.ply"))


@pytest.mark.parametrize("part", ["meta.json", "means_l.webp", "sh0.webp"])
def test_a_part_of_a_sog_folder_that_is_a_pipe_is_refused(part, unnoticed, tmp_path):
    ps.save(ball(40), tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "sog")
    assert len(ps.load(tmp_path / "sog")) == 40
    unnoticed(tmp_path / "sog" / part)
    refused(ps.load, tmp_path / "sog")


def test_rows_of_a_ply_that_became_a_pipe_are_refused(unnoticed, tmp_path):
    ps.save(ball(40), tmp_path / "a.ply")
    rows = PlyRows(tmp_path / "a.ply")
    unnoticed(tmp_path / "a.ply")
    with pytest.raises(SceneError, match="a.ply: cannot be read .not a regular file"):
        rows.read(0, 40)


@pytest.mark.parametrize(
    "name", ["transforms.json", "cameras.json", "cameras.bin", "cameras.txt", "images.txt"]
)
def test_camera_files_that_are_pipes_are_refused(name, unnoticed, tmp_path):
    path = unnoticed(tmp_path / name)
    others = {"cameras.bin": "images.bin", "cameras.txt": "images.txt", "images.txt": "cameras.txt"}
    if name in others:
        (tmp_path / others[name]).touch()
    refused(read_named_views, path)


def test_points_that_are_a_pipe_are_no_points(unnoticed, tmp_path):
    (tmp_path / "images.bin").touch()
    unnoticed(tmp_path / "points3D.bin")
    assert colmap_points(tmp_path) is None


def test_a_config_that_is_a_pipe_is_refused(unnoticed, tmp_path):
    refused(read_config, unnoticed(tmp_path / "run" / "config.yml"))
    shutil.rmtree(tmp_path / "run")
