"""lab/judge: the camera paths that ship, what is measured in their views, and rows that are kept."""

import json

import pytest
import torch

import pointsplat_ns as ps
from lab.judge import camera_paths, judge, levels, record, scenes
from making import run_of
from peers import peer

PATHS = sorted(camera_paths.FOLDER.glob("*.json"))


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_path_that_ships_has_sixteen_upright_views_from_different_places(path):
    found, views = camera_paths.read_path(path), camera_paths.views_of(path, 320)
    assert len(views) == 16 and 60 <= found.field_of_view <= 70
    assert len({tuple(eye) for eye in torch.cat([found.eyes, found.ats], 1).tolist()}) == 16
    up = found.up / found.up.norm()
    right, down = views.viewmats[:, 0, :3], views.viewmats[:, 1, :3]
    assert (right @ up).abs().max() < 1e-12  # the horizon is level
    assert (down @ up).max() < -0.3  # and up is up: no view looks down or up by more than about 70 degrees


def test_every_way_has_a_row_for_each_width(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    options = {"keep": (0.5,), "ways": ("prune",), "widths": (32, 64), "views": 2, "lpips": False}
    judge.main((small,), **options, splat_transform=(peer(tmp_path, "3.7.0"),), json_path=results)
    said = capsys.readouterr().out
    content = json.loads(results.read_text())
    labels = ["prune", "splat-transform 3.7.0 -d", "splat-transform 3.7.0 adaptive"]
    assert [(row["at"], row["method"]) for row in content["rows"]] == [(at, m) for at in (32, 64) for m in labels]
    for row in content["rows"]:
        assert (row["gaussians"], row["count"], row["views"], row["failed"]) == (900, 450, 2, "")
        assert row["peak_bytes"] > 5e6 and row["seconds"] > 0 and row["cpu_seconds"] > 0
        assert 0 < row["covered_psnr"] < 100 and 0 < row["dense_ssim"] < 1
    assert said.count("covered PSNR") == 1 and " ".join(said.split()).count("splat-transform 3.7.0 adaptive") >= 1
    assert {path.name for path in tmp_path.iterdir()} == {"small.ply", "small.json", "rows.json", "peer-3.7.0"}


def test_a_way_that_fails_is_noted_and_measured_again(small, tmp_path, capsys):
    results, broken = tmp_path / "rows.json", peer(tmp_path, "2.0.0", fails="--decimate")
    options = {"keep": (0.5,), "ways": (), "widths": (32,), "views": 1, "lpips": False, "json_path": results}
    judge.main((small,), **options, splat_transform=(broken, peer(tmp_path, "2.7.1")))
    said = capsys.readouterr().out
    failed, fine = json.loads(results.read_text())["rows"]
    assert failed["method"] == "splat-transform 2.0.0" and "out of luck" in failed["failed"]
    assert failed["covered_psnr"] is failed["seconds"] is None and fine["covered_psnr"] > 0
    assert "splat-transform 2.0.0 at 50 % failed" in said
    judge.main((small,), **options, resume=True, splat_transform=(peer(tmp_path, "2.0.0"),))
    rows = json.loads(results.read_text())["rows"]
    assert [row["failed"] for row in rows] == ["", ""] and rows[1] == fine


def test_a_run_is_judged_by_its_held_out_photos_in_their_size(trained_walls, tmp_path, capsys):
    results = tmp_path / "rows.json"
    run = run_of(trained_walls, "wall-a")
    options = {"keep": (0.5,), "ways": (), "views": 2, "lpips": False, "json_path": results}
    judge.main((run,), **options, splat_transform=(peer(tmp_path, "2.7.1"),))
    [row] = json.loads(results.read_text())["rows"]
    assert (row["scene"], row["at"], row["views"]) == ("wall-a", "photos", 2)
    assert 0 < row["photo_psnr"] < 100 and row["photo_psnr"] != row["dense_psnr"]
    assert "photo PSNR" in " ".join(capsys.readouterr().out.split())


def test_means_and_leads_are_over_scenes_that_have_every_way():
    rows = [
        {"scene": scene, "keep": 0.1, "method": method, "at": 960, "failed": "", "cpu_seconds": 1.0, "peak_bytes": 1e9}
        | dict.fromkeys(scenes.MEASURES)
        | {"covered_psnr": psnr}
        for scene, *psnrs in (("rock", 25, 27, 24, 23), ("chair", 30, 31, 26, 28), ("can", 40, 41))
        for method, psnr in zip(("prune", "compact", "splat-transform 3 -d", "splat-transform 2"), psnrs, strict=False)
    ]
    figures = record.Figures(rows)
    text = record.section(figures, 960)
    assert figures.scenes(960) == "2"
    assert "| 10 % | 26.00 (24.00 rock) | 27.50 (25.00 rock) | 29.00 (27.00 rock) |" in text
    assert "| 10 % | +1.50 (+1.00 rock) | +1.50 (+1.00 chair) |" in text


def test_levels_of_a_stream_are_judged_beside_merges_of_their_counts(small, tmp_path, capsys):
    ps.lod(small, ["100%", "40%", "20%"], folder=tmp_path / "stream", stream=True, resolution=(64, 48))
    results = tmp_path / "levels.json"
    levels.main(tmp_path / "stream" / "lod-meta.json", "small", widths=(32, 64), json_path=results)
    rows = json.loads(results.read_text())
    assert [(row["way"], row["count"]) for row in rows] == [(w, n) for w in ("its level", "prune") for n in (360, 180)]
    assert all(row["worst_64"] < row["mean_64"] < 60 for row in rows)
    assert "900 Gaussians" in capsys.readouterr().out
