"""Files: found, opened and replaced."""

import csv
import os
import shutil
import stat
from pathlib import Path

import pytest
from foreign import write_sog_folder
from refusing import fails

import pointsplat_ns as ps
from making import cloud, normal_scene, same_bits
from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.discovery import FOLDER_FILES, find_scenes
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.reading import read_scene, save, source_file
from pointsplat_ns.system.files import replacing, write_csv


def write(path: Path, text: str = "new") -> None:
    with replacing(path) as part:
        part.write_text(text)


@pytest.mark.parametrize("name", ["x" * 300 + "/a.ply", "\u00e9" * 128])
def test_a_name_that_is_too_long_is_the_error_that_is_told(tmp_path, name):
    with pytest.raises(SceneError, match=r"cannot be written \(File name too long\)"):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "path", ["/proc/a.ply", "/dev/null/a.ply", "/dev/null", "file/a.ply", "nul\0/a.ply"]
)
def test_a_place_where_no_file_can_be_is_one_error(tmp_path, path):
    (tmp_path / "file").touch()
    said = "a.ply: cannot be written|/dev/null: not a regular file|contains a NUL character"
    with pytest.raises(SceneError, match=said):
        write(tmp_path / path)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@pytest.mark.parametrize("relative", [True, False])
def test_output_through_a_link_is_written_to_its_target(tmp_path, relative):
    (tmp_path / "real").mkdir()
    target = tmp_path / "real" / "a.ply"
    link = tmp_path / "link.ply"
    target.write_text("old")
    link.symlink_to("real/a.ply" if relative else target)
    write(link)
    assert link.is_symlink() and target.read_text() == "new"
    assert [path.name for path in target.parent.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("target", ["gone.ply", "missing/gone.ply", "link.ply"])
def test_a_link_that_leads_nowhere_is_refused_and_makes_no_file(target, tmp_path):
    """Whoever made it may want a file to appear there, such as one that a shell runs."""
    link = tmp_path / "link.ply"
    link.symlink_to(target)
    with pytest.raises(
        SceneError, match="link.ply: (a broken link to .*; remove it|not a regular file)"
    ):
        write(link)
    assert [*tmp_path.iterdir()] == [link] and link.is_symlink()


@pytest.mark.parametrize("mode", [0o600, 0o444])
def test_a_file_that_is_replaced_keeps_its_mode(tmp_path, mode):
    path = tmp_path / "a.ply"
    path.write_text("old")
    path.chmod(mode)
    with replacing(path) as part:
        part.write_text("new")
        assert stat.S_IMODE(part.stat().st_mode) & 0o077 == 0, (
            "others could read it before it is complete"
        )
    assert path.read_text() == "new" and stat.S_IMODE(path.stat().st_mode) == mode


@pytest.mark.parametrize("name", ["a.ply", "a.sog"])
def test_a_scene_replaces_a_file_only_where_it_is_to(tmp_path, name):
    path = tmp_path / name
    ps.save(cloud(3), path)
    with pytest.raises(
        SceneError, match="exists already; name another file, or replace it with overwrite=True"
    ):
        ps.save(cloud(4), path)
    assert len(ps.load(path)) == 3
    ps.save(cloud(4), path, overwrite=True)
    assert len(ps.load(path)) == 4


def test_a_sog_folder_is_read_by_both_names_and_known_by_all_its_files(tmp_path):
    folder = tmp_path / "room"
    write_sog_folder(normal_scene(5), folder)
    ps.save(normal_scene(5), tmp_path / "room.sog")
    scenes = [ps.load(place) for place in (tmp_path / "room.sog", folder, folder / "meta.json")]
    assert same_bits(scenes[0], scenes[1]) and same_bits(scenes[0], scenes[2])
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


POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"


def test_only_files_and_the_newest_run_of_each_experiment_are_scenes(make_run, tmp_path, caplog):
    folder = tmp_path / "outputs"
    make_run("kitchen", time="2024-05-06_070809", steps=(9,))
    newest = make_run("kitchen", method="splatfacto-cpu", time="2025-05-06_070809", steps=(19,))
    make_run("kitchen", time="2026-05-06_070809", steps=())
    for method in ("nerfacto", "pointsplat"):
        make_run("of-another-kind", method=method)
    write_ply(cloud(3), newest / "compact.ply")  # in the folder of a run
    for name in ("hall.ply", "deep/er/HALL.PLY", "kitchen.ply", ".hidden/x.ply", "made/y.ply"):
        write_ply(cloud(3), folder / name)
    (folder / "made" / FOLDER_FILES.scenes).touch()
    (folder / "points.ply").write_bytes(POINTS)
    (folder / "notes.txt").touch()
    found = find_scenes(folder)
    plys = {"deep/er/HALL": "deep/er/HALL.PLY", "hall": "hall.ply", "kitchen_ply": "kitchen.ply"}
    assert found == {"kitchen": newest, **{name: folder / path for name, path in plys.items()}}
    assert all(len(read_scene(path)) > 0 for path in found.values())
    assert "skipped" in caplog.text and "points.ply" in caplog.text


def test_a_run_no_folder_and_a_folder_without_scenes_are_refused(make_run, tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in (make_run(), tmp_path / "gone"):
        with pytest.raises(SceneError, match="expected a folder with scenes below it"):
            find_scenes(folder)
    said = ("no scene below it; expected files (", ") or trained Splatfacto runs")
    fails(lambda: find_scenes(tmp_path / "empty"), *said, error=SceneError)


def test_results_of_earlier_commands_are_no_scenes(tmp_path, caplog):
    made = ("room_pruned.ply", "room_compact.spz", "room_lod/level_0.ply")
    for name in ("room.sog", "other_compact.ply", "deep/room_pruned.ply", *made):
        save(cloud(50, 0, 1), tmp_path / name)
    (tmp_path / "room_lod" / "lod.json").touch()
    assert [*find_scenes(tmp_path)] == ["deep/room_pruned", "other_compact", "room"]
    assert (
        f"skipped {tmp_path / 'room_compact.spz'}: a result of {tmp_path / 'room'}" in caplog.text
    )


@pytest.mark.parametrize(
    "text", ["=1+1", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\N{FULLWIDTH EQUALS SIGN}1"]
)
def test_a_text_that_is_a_formula_gets_an_apostrophe(text, tmp_path):
    write_csv([{"name": text, "loss": -1.5, "note": "a=b", "none": None}], tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as stream:
        assert [*csv.DictReader(stream)] == [
            {"name": f"'{text}", "loss": "-1.5", "note": "a=b", "none": ""}
        ]
