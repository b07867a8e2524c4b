"""The file of a shown scene is written again or disappears: the viewer notices, and says so."""

import json
import shutil
import urllib.request
import zipfile
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball, run_of
from pointsplat_ns.tools.pages.viewer import Viewer
from pointsplat_ns.tools.watched_file import FileState, WatchedFile

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def scene(tmp_path) -> Path:
    ps.save(ball(40, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def test_a_file_that_is_written_again_has_changed(scene):
    watched = WatchedFile(scene)
    assert watched.state() is FileState.SAME
    ps.save(ball(40, opacity=1.0, bright=1.0), scene, overwrite=True)  # of the same size
    assert watched.state() is FileState.CHANGED


def test_a_file_that_is_removed_is_gone(scene):
    watched = WatchedFile(scene)
    aside = scene.rename(scene.with_name("aside.ply"))
    assert watched.state() is FileState.GONE
    aside.rename(scene)
    assert watched.state() is FileState.SAME, "the file itself is back"


def test_each_part_of_a_sog_folder_counts(tmp_path):
    ps.save(ball(40), tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "sog")
    watched = WatchedFile(tmp_path / "sog")
    part = tmp_path / "sog" / "sh0.webp"
    part.write_bytes(part.read_bytes() + b"\0")
    assert watched.state() is FileState.CHANGED
    shutil.rmtree(tmp_path / "sog")
    assert watched.state() is FileState.GONE


def test_a_later_checkpoint_of_a_run_counts(trained_walls, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(run_of(trained_walls, "wall-a"), run)
    watched = WatchedFile(run)
    (checkpoint,) = (run / "nerfstudio_models").iterdir()
    assert watched.state() is FileState.SAME
    shutil.copy(checkpoint, checkpoint.with_name("step-000000099.ckpt"))
    assert watched.state() is FileState.CHANGED


def watched_notes(viewer: Viewer) -> list[str]:
    with urllib.request.urlopen(f"{viewer.url}/watch", timeout=60) as answer:
        content = json.load(answer)
    assert content["stage"] == 1
    return content["notes"]


def test_the_viewer_says_which_scene_has_changed_or_is_gone(scene):
    other = scene.with_name("other.ply")
    shutil.copy(scene, other)
    with ps.open_viewer(scene, other, port=0) as viewer:
        assert watched_notes(viewer) == []
        ps.save(ball(30, opacity=1.0, bright=1.0), other, overwrite=True)
        (note,) = watched_notes(viewer)
        assert note == (
            "other.ply has changed on disk: the page shows other.ply as it was read; start "
            "pointsplat view again"
        )
        scene.unlink()
        first, second = watched_notes(viewer)
        assert first.startswith("room.ply is gone from disk, or cannot be read") and second == note


def test_scenes_in_memory_have_no_file_that_may_change():
    with ps.open_viewer(ball(40, opacity=1.0, bright=1.0), port=0) as viewer:
        assert watched_notes(viewer) == []
