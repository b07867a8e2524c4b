"""Cameras, views of a dataset and the data manager."""

import copy
import dataclasses
import shlex
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig

import pointsplat_ns as ps
from making import run_of
from pointsplat_ns.cli import main
from pointsplat_ns.compression.requests import PHOTO_STEPS
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.pictures import in_unit_range
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, carried, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanagerConfig
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
from pointsplat_ns.views import EPS2D, NEAR_PLANE, Views

SEED = 20

BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def some_cameras(num: int = 3) -> Cameras:
    generator = torch.Generator().manual_seed(SEED)
    turn = torch.linalg.qr(torch.randn(num, 3, 3, generator=generator))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None]
    poses = torch.cat([turn, torch.randn(num, 3, 1, generator=generator)], dim=2)
    return Cameras(poses, 35.0, 36.0, 20.5, 14.0, 40, 30, camera_type=CameraType.PERSPECTIVE)


@pytest.fixture
def views() -> Views:
    return views_of_cameras(some_cameras(), BACKGROUND, "antialiased")


def test_a_view_sees_a_point_at_the_pixel_of_nerfstudios_ray(views):
    cameras = some_cameras()
    at = torch.tensor([12.5, 31.5])  # row and column, at pixel centres as nerfstudio counts
    rays = cameras.generate_rays(torch.tensor([[1]]), coords=at[None])
    point = rays.origins[0] + 2.5 * rays.directions[0]
    in_camera = views.viewmats[1] @ torch.cat([point, torch.ones(1)])
    pixel = views.Ks[1] @ in_camera[:3]
    assert in_camera[2] > 0
    # 1e-3 pixels: float32 rays
    torch.testing.assert_close(pixel[:2] / pixel[2], at.flip(0), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("near_plane", "eps2d"), [(NEAR_PLANE, EPS2D), (1e-7, 0.0), (300.0, 1.0)])
def test_near_plane_and_eps2d_go_to_nerfstudios_cameras_and_back(views, near_plane, eps2d):
    cameras = cameras_of_views(dataclasses.replace(views, near_plane=near_plane, eps2d=eps2d))
    for some in (cameras, cameras[1:2], copy.deepcopy(cameras).to("cpu")):
        assert carried(some) == {"near_plane": near_plane, "eps2d": eps2d}
        again = views_of_cameras(some, BACKGROUND)
        assert (again.near_plane, again.eps2d) == (near_plane, eps2d)


def test_cameras_of_several_near_planes_or_sizes_are_refused(views):
    cameras = cameras_of_views(views)
    cameras.metadata["near_plane"] = torch.tensor([[0.1], [0.1], [0.2]])
    with pytest.raises(DataError, match="2 values of near_plane; expected one for all views"):
        views_of_cameras(cameras, BACKGROUND)
    cameras = some_cameras()
    cameras.width = torch.tensor([[40], [41], [40]])
    with pytest.raises(DataError, match="photos of 2 sizes; expected one size for all views"):
        views_of_cameras(cameras, BACKGROUND)


def datamanagers(wall_scene, **settings):
    parser = ReplicaDataParserConfig(data=wall_scene, load_seed_points=False, eval_every=3)
    lazy = LazyImageDatamanagerConfig(dataparser=parser, **settings).setup(device="cpu")
    stock = FullImageDatamanagerConfig(dataparser=parser, cache_images_type="uint8").setup(device="cpu")
    return lazy, stock


def test_datamanager_gives_what_nerfstudios_gives_in_its_order(wall_scene):
    lazy, stock = datamanagers(wall_scene, cache_gigabytes=3e-5)  # room for three photos
    for step in range(2 * len(lazy.train_dataset) + 1):
        (camera, data), (other, expected) = lazy.next_train(step), stock.next_train(step)
        assert data["image_idx"] == expected["image_idx"] == camera.metadata["cam_idx"]
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
        assert torch.equal(camera.get_intrinsics_matrices(), other.get_intrinsics_matrices())
    assert lazy.frame_cache._entries.currsize <= 3e4
    assert lazy.get_train_rays_per_batch() == stock.get_train_rays_per_batch()
    ours, theirs = list(lazy.fixed_indices_eval_dataloader), list(stock.fixed_indices_eval_dataloader)
    assert len(ours) == len(theirs) == len(lazy.fixed_indices_eval_dataloader) > 1
    for (camera, data), (other, expected) in zip(ours, theirs, strict=True):
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
    seen = [lazy.next_eval(step)[1]["image_idx"] for step in range(len(ours))]
    assert sorted(seen) == list(range(len(ours)))


def mean_psnr(scene: Gaussians, run: Path) -> float:
    photos = run_photos(run, "test")
    errors = [ps.psnr(ps.render(scene, photo.view), in_unit_range(photo.target)) for photo in photos]
    return float(torch.stack(errors).mean())


def test_a_sweep_trains_on_the_photos_of_a_run_as_its_command_does(trained_walls, tmp_path, monkeypatch):
    run = run_of(trained_walls, "wall-b")
    monkeypatch.setitem(PHOTO_STEPS, "quick", 96)
    found = ps.measure_tradeoff(run, tmp_path / "trade", keep=("10%",), repairs=("none", "photos"))
    assert found.points[0].against_photos.psnr == pytest.approx(mean_psnr(ps.load(run), run), abs=1e-4)
    assert found.scene == "wall-b" and found.views_origin == "held-out photos of the dataset"
    trained = next(point for point in found.points if point.repair == "photos")
    pruned = next(point for point in found.points if point.repair == "none" and point.gaussians == trained.gaussians)
    assert trained.against_photos.psnr > pruned.against_photos.psnr + 0.1
    program, *words = shlex.split(trained.command)
    assert program == "pointsplat" and "--photos" in words
    monkeypatch.chdir(tmp_path)
    main(words)
    (made,) = tmp_path.glob("*.ply")
    assert mean_psnr(ps.load(made), run) == pytest.approx(trained.against_photos.psnr, abs=0.01)


def test_photos_of_no_run_are_refused(tmp_path):
    ps.save(ps.example_room()[::200][:300], tmp_path / "room.ply")
    with pytest.raises(ps.PointSplatError, match="not a nerfstudio run"):
        ps.measure_tradeoff(tmp_path / "room.ply", tmp_path / "trade", repairs=("none", "photos"))
    assert not (tmp_path / "trade" / "tradeoff.json").exists()
