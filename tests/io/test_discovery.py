"""Which scenes there are below a folder."""

import pytest

from making import cloud
from pointsplat_ns.errors import SceneError
from pointsplat_ns.io import find_runs, read_scene, write_ply
from pointsplat_ns.io.discovery import FOLDER_FILES, find_scenes
from pointsplat_ns.io.scene import is_folder_of_scenes, save

POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"


def test_files_and_the_newest_run_of_each_experiment_are_scenes_and_nothing_else_is(make_run, tmp_path, caplog):
    folder = tmp_path / "outputs"
    make_run("kitchen", time="2024-05-06_070809", steps=(9,))
    newest = make_run("kitchen", method="splatfacto-cpu", time="2025-05-06_070809", steps=(19,))
    make_run("of-another-kind", method="nerfacto")
    write_ply(cloud(3), newest / "compact.ply")  # in the folder of a run
    for name in ("hall.ply", "deep/er/HALL.PLY", "kitchen.ply", ".hidden/x.ply", "made/y.ply"):
        write_ply(cloud(3), folder / name)
    (folder / "made" / FOLDER_FILES.scenes).touch()
    (folder / "points.ply").write_bytes(POINTS)
    (folder / "notes.txt").touch()
    found = {scene.name: scene.path for scene in find_scenes(folder)}
    assert found == {
        "deep/er/HALL": folder / "deep/er/HALL.PLY",
        "hall": folder / "hall.ply",
        "kitchen": newest,
        "kitchen_ply": folder / "kitchen.ply",
    }
    assert all(len(read_scene(path)) > 0 for path in found.values())
    assert "passed over" in caplog.text and "points.ply" in caplog.text


def test_a_run_is_named_by_its_experiment_wherever_the_search_begins(make_run, tmp_path):
    run = make_run("kitchen")
    assert [scene.name for scene in find_scenes(tmp_path)] == ["outputs/kitchen"]
    for folder in (run.parent, run.parents[1]):
        assert [scene.name for scene in find_scenes(folder)] == ["kitchen"]
    assert find_runs(run)[0].folder == run


def test_a_run_no_folder_and_a_folder_without_scenes_are_refused(make_run, tmp_path):
    (tmp_path / "empty").mkdir()
    for folder, said in (
        (make_run(), "expected a folder with scenes below it"),
        (tmp_path / "gone", "expected a folder with scenes below it"),
        (tmp_path / "empty", "no scene below it; expected files \\(.*\\) or trained Splatfacto runs"),
    ):
        with pytest.raises(SceneError, match=said):
            find_scenes(folder)


def test_files_of_every_format_are_scenes_and_a_sog_folder_is_one_scene(tmp_path):
    for name in ("a.spz", "b.sog", "c.splat", "d.compressed.ply", "e.glb", "folder/meta.json"):
        save(cloud(50, 0, 1), tmp_path / name)
    assert [scene.name for scene in find_scenes(tmp_path)] == ["a", "b", "c", "d", "e"]
    assert is_folder_of_scenes(tmp_path) and not is_folder_of_scenes(tmp_path / "folder")
    assert not is_folder_of_scenes(tmp_path / "a.spz")


def test_files_that_differ_in_their_format_alone_have_names_that_say_it(tmp_path):
    files = ("room.ply", "room.spz", "room.compressed.ply", "deep/room.spz", "hall.spz", "hall_spz.ply")
    for name in files:
        save(cloud(50, 0, 1), tmp_path / name)
    names = {str(scene.path.relative_to(tmp_path)): scene.name for scene in find_scenes(tmp_path)}
    assert names == dict(
        zip(files, ("room_ply", "room_spz", "room_compressed_ply", "deep/room", "hall", "hall_spz"), strict=True)
    )


def test_results_of_earlier_commands_are_no_scenes(tmp_path, caplog):
    made = ("room_pruned.ply", "room_compact.spz", "room_lod/level_0.ply", "room_tradeoff/room_10pct.ply")
    for name in ("room.sog", "other_compact.ply", "deep/room_pruned.ply", *made):
        save(cloud(50, 0, 1), tmp_path / name)
    (tmp_path / "room_lod" / "lod.json").touch()
    (tmp_path / "room_tradeoff" / "tradeoff.json").touch()
    assert [scene.name for scene in find_scenes(tmp_path)] == ["deep/room_pruned", "other_compact", "room"]
    assert f"passed over {tmp_path / 'room_compact.spz'}: a result of {tmp_path / 'room'}" in caplog.text
