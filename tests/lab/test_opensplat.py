"""lab/training/opensplat.py: what both programs get, and what is noted while one trains."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

import pointsplat_ns as ps
from lab.training import opensplat
from making import cloud
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig


def test_both_get_the_same_photos_poses_and_points_and_one_of_them_no_held_out_frame(wall_scene, tmp_path):
    opensplat.exported(wall_scene, tmp_path, 2)
    parser = ReplicaDataParserConfig(data=wall_scene).setup()
    train, test = (parser.get_dataparser_outputs(split) for split in ("train", "test"))
    ours, theirs = (json.loads((tmp_path / name).read_text()) for name in ("transforms.json", "train/transforms.json"))
    assert len(ours["train_filenames"]) == len(train.image_filenames) == len(theirs["frames"])
    assert len(ours["test_filenames"]) == len(test.image_filenames)
    assert not {*ours["train_filenames"]} & {*ours["test_filenames"]}
    for frame, pose in zip(theirs["frames"], train.cameras.camera_to_worlds, strict=True):
        assert (tmp_path / "train" / frame["file_path"]).is_file()
        torch.testing.assert_close(torch.tensor(frame["transform_matrix"])[:3], pose)
    assert ours["fl_x"] == pytest.approx(float(train.cameras.fx[0]) / 2)
    assert abs(ours["cx"] - ours["w"] / 2) <= 0.5 and abs(ours["cy"] - ours["h"] / 2) <= 0.5
    points = PlyData.read(tmp_path / "points.ply")["vertex"]
    assert points.count == len(train.metadata["points3D_xyz"]) and points["red"].dtype.itemsize == 1


def test_photos_are_cut_so_that_the_principal_point_is_in_their_middle():
    for principal, expected in (((160.0, 120.0), (0, 0, 320, 240)), ((150.2, 131.0), (0, 22, 300, 218))):
        corner, size = opensplat.centred(torch.tensor(principal), torch.tensor([320, 240]))
        assert (*corner.tolist(), *size.tolist()) == expected


def test_times_of_what_a_training_saves_are_noted_and_a_finished_one_is_left_alone(tmp_path):
    scene = tmp_path / "scene.ply"
    ps.save(cloud(10), scene)
    program = f"import shutil, time; time.sleep(0.3); shutil.copy({str(scene)!r}, 'splat_5.ply'); time.sleep(0.3); "
    program += f"shutil.copy({str(scene)!r}, 'splat.ply'); time.sleep(0.3)"
    words = [sys.executable, "-c", f"import os; os.chdir({str(tmp_path / 'run')!r}); {program}"]
    opensplat.train(words, tmp_path / "run", {})
    times = json.loads((tmp_path / "run" / "times.json").read_text())
    assert [*times] == ["splat_5.ply", "splat.ply"] and 0.3 <= times["splat_5.ply"][1] < times["splat.ply"][1]
    opensplat.train(["no such program"], tmp_path / "run", {})
    with pytest.raises(PointSplatError, match=r"it ended with status 3; see .*log\.txt"):
        opensplat.train([sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "other", {})


def test_the_table_says_when_ours_is_as_good_as_the_better_of_the_others(tmp_path, capsys):
    ends = {opensplat.OURS: 30.0, opensplat.SCALED: 28.0, opensplat.DEFAULTS: 20.0}
    found = [
        opensplat.Look("kitchen", method, step, minutes, minutes, 10, psnr - 5 * (step == 1))
        for method, psnr in ends.items()
        for step, minutes in ((1, 1.0), (2, 2.0), (3, 8.0))
    ]
    opensplat.print_table(found)
    printed = capsys.readouterr().out
    assert "0.25" in printed and printed.count("never") == 1
    opensplat.draw(found, Path(tmp_path / "curves.png"))
    assert (tmp_path / "curves.png").stat().st_size > 5000
