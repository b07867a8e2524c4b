"""Poses and photos of a run's dataset; and that a scene is judged by its held-out photos."""

import json
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_photos
from pointsplat_ns.tradeoff import machine, outputs


@pytest.fixture()
def run(trained_walls) -> Path:
    """The run of SH degree 1 over white."""
    (config,) = (trained_walls / "wall-b").rglob("config.yml")
    return config.parent


def test_photos_come_with_the_views_that_they_show(run):
    """What a camera of these views sees of a wall with the photos' colours: the middle pixel of each photo."""
    views, photos = dataset_photos(run, "test", 100)
    poses = ps.dataset_views(run, "test")
    assert len(views) == len(photos) == len(poses)
    assert torch.allclose(views.viewmats, poses.viewmats, atol=1e-6) and torch.allclose(views.Ks, poses.Ks)
    assert all(photo.shape == (views.height, views.width, 3) for photo in photos)
    assert all(0 <= float(photo.min()) and 0.5 < float(photo.max()) <= 1 for photo in photos)
    assert torch.equal(views.background, poses.background) and views.rasterize_mode == "antialiased"


def test_fewer_photos_are_spread_over_all_of_them(run):
    views, photos = dataset_photos(run, "train", 3)
    every, of_all = dataset_photos(run, "train", 100)
    assert len(views) == len(photos) == 3 < len(every)
    for index, place in ((0, 0), (2, len(every) - 1)):
        assert torch.equal(photos[index], of_all[place]) and torch.equal(views.viewmats[index], every.viewmats[place])


def test_a_run_that_is_none_has_no_photos(tmp_path):
    with pytest.raises(SceneError, match="expected a nerfstudio run"):
        dataset_photos(tmp_path / "gone", "test", 3)


def test_a_run_is_measured_against_its_held_out_photos(run, tmp_path, plain_page, no_lpips, monkeypatch):
    monkeypatch.setattr(machine, "LOCK", machine.MeasuringLock(str(tmp_path / "lock"), pause=0.0))
    monkeypatch.setattr(outputs, "plot", lambda sweep, against, path: path.write_text(against))
    found = ps.measure_tradeoff(run, tmp_path / "trade", points=2, repairs=("none",))
    dense, small = found.points
    views, photos = dataset_photos(run, "test", 10)
    scene = ps.load(run)
    errors = [ps.psnr(ps.render(scene, view), photo) for view, photo in zip(views, photos, strict=True)]
    assert dense.against_photos.psnr == pytest.approx(float(torch.stack(errors).mean()), abs=1e-4)
    assert small.against_photos is not None and small.gaussians < dense.gaussians
    assert found.scene == "wall-b" and found.views_origin == "held-out photos of the dataset"
    written = json.loads((tmp_path / "trade" / "tradeoff.json").read_text())
    assert written["points"][0]["against_photos"]["psnr"] == dense.against_photos.psnr
