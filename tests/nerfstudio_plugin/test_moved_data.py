"""Runs whose photos and poses are no longer where they were: named anew, or done without and said."""

import json
import shutil
from pathlib import Path

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
import pointsplat_ns as ps
from making import run_of, without_data
from pointsplat_ns.cli import main
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene


@pytest.fixture
def runs(trained_walls, tmp_path) -> Path:
    """Two runs whose data is gone from where they say."""
    return without_data(trained_walls, tmp_path / "runs")


@pytest.fixture
def moved(wall_scene, tmp_path) -> Path:
    shutil.copytree(wall_scene.parent, tmp_path / "moved")
    return tmp_path / "moved"


def keep_data_of(runs: Path, name: str, trained_walls: Path) -> None:
    shutil.copy(run_of(trained_walls, name) / "config.yml", run_of(runs, name) / "config.yml")


def test_the_data_is_found_at_or_below_the_folder_that_is_named(runs, moved, trained_walls):
    run, known = run_of(runs, "wall-a"), ps.dataset_views(run_of(trained_walls, "wall-a"))
    with pytest.raises(SceneError, match=r"gone_from_here.*name the folder where it is now \(--data DIR\)"):
        ps.dataset_views(run)
    for place in (moved, moved / "wall"):
        assert torch.equal(ps.dataset_views(run, data=place).viewmats, known.viewmats)
    with pytest.raises(SceneError, match="nowhere: no such folder; expected the data of .*gone_from_here"):
        ps.dataset_views(run, data=moved / "nowhere")


COMMANDS = {
    "prune": "RUN --keep 50% --by lightgaussian -o OUT/a.ply --json",
    "compact": "RUN --keep 50% --effort instant -o OUT/a.ply --json",
    "clean": "RUN -o OUT/a.ply",
    "lod": "RUN --levels 50% -o OUT/lod",
    "render": "RUN --seconds 0.1 -o OUT/a.png",
    "tradeoff": "RUN --keep 10% --views 2 --repairs none -o OUT/trade",
    "info": "RUN --views OUT/a.png",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_takes_the_folder_and_refuses_one_without_the_data(command, runs, moved, tmp_path, capfd):
    words = COMMANDS[command].replace("RUN", str(run_of(runs, "wall-b"))).replace("OUT", str(tmp_path)).split()
    with pytest.raises(SystemExit) as ended:
        main([command, *words, "--data", str(tmp_path / "nowhere")])
    assert ended.value.code == 1 and "nowhere: no such folder" in capfd.readouterr().err
    main([command, *words, "--data", str(moved)])
    said = capfd.readouterr()
    assert "sampled in free space" not in said.out + said.err and "gone_from_here" not in said.out + said.err


def test_data_is_not_for_a_scene_without_a_run(moved, tmp_path):
    ps.save(ps.example_room()[::200], tmp_path / "room.ply")
    for scene in (tmp_path / "room.ply", ps.example_room()[::200]):
        with pytest.raises(SceneError, match="no run, so it has no data at"):
            ps.prune(scene, 100, data=moved)


def test_a_run_without_its_data_does_not_stop_a_folder_and_is_named(runs, trained_walls, tmp_path):
    keep_data_of(runs, "wall-a", trained_walls)
    results = ps.compact_folder(runs, tmp_path / "out", "50%", effort="instant")
    assert [result.status for result in results] == ["done", "done"]
    assert results[0].note == "" and results[1].note.startswith("no dataset: ") and "gone_from_here" in results[1].note
    assert json.loads((tmp_path / "out" / "wall-b.ply.json").read_text())["note"] == results[1].note


def test_a_folder_of_runs_is_done_with_the_data_at_its_new_place(runs, moved, tmp_path):
    results = ps.compact_folder(runs, tmp_path / "out", "50%", effort="instant", data=moved)
    assert [(result.status, result.note) for result in results] == [("done", ""), ("done", "")]
    with pytest.raises(SceneError, match="holds results of other options"):
        ps.compact_folder(runs, tmp_path / "out", "50%", effort="instant")


def test_a_training_leaves_out_a_run_without_its_photos_and_names_it(runs, moved, trained_walls, capfd):
    def manager_of(**settings):
        return ScenesDataManagerConfig(data=runs, cache_gigabytes=0.01, **settings).setup(test_mode="val")

    with pytest.raises(SceneError, match="gone_from_here.*that of 1 more runs; .*scene-data DIR.*supervision dense"):
        manager_of()
    assert [scene.name for scene in manager_of(scene_data=moved).scenes] == ["wall-a", "wall-b"]
    keep_data_of(runs, "wall-a", trained_walls)
    capfd.readouterr()
    assert [scene.name for scene in manager_of().scenes] == ["wall-a"]
    assert "wall-b is left out" in capfd.readouterr().out.replace("\n", " ")
    dense = manager_of(supervision="dense").scenes
    assert [scene.has_photos for scene in dense if isinstance(scene, TrainedScene)] == [True, False]


def test_a_refiners_run_finds_the_scenes_that_moved(make_refined_run, trained_walls, runs, tmp_path):
    run = make_refined_run(tmp_path / "out", tmp_path / "gone" / "runs")
    with pytest.raises(SceneError, match="gone"):
        ps.load(run)
    assert len(ps.load(run, data=tmp_path)) > 0
